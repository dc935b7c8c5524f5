"""Dynamics on random trees: Pinocchio's figures, and the laws of mechanics."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import jacfwd, jacrev, jvp, vmap

import forcegp
from forcegp import dynamics
from forcegp.errors import ShapeError
from forcegp.robot.model import RobotModel
from random_robots import Mirror, random_robot
from robots import kinetic_energy, potential_energy, random_states

SEEDS = range(8)
EXACT = 1e-10  # of the largest entry: double precision over some hundred operations, with a wide margin
LARGE = 300  # samples: enough for the algorithms of large batches, on every robot here


def relative(ours: Tensor, theirs: object) -> float:
    expected = np.asarray(theirs)
    return float(np.abs(ours.numpy() - expected).max() / max(np.abs(expected).max(), 1e-12))


def rounding(M: Tensor) -> float:
    """What rounding in M may cost an acceleration: its condition number times the machine precision."""
    return max(EXACT, 4.0 * torch.finfo(M.dtype).eps * float(torch.linalg.cond(M).max()))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("batch", [2, LARGE])
def test_random_trees_against_pinocchio(seed: int, batch: int) -> None:
    robot = random_robot(seed)
    mirror = Mirror(robot)
    q, qd, qdd, force = random_states(robot, batch, seed)
    M, Q_G = dynamics.mass_matrix(robot, q), dynamics.gravity_force(robot, q)
    Q_C, ID = dynamics.bias_force(robot, q, qd), dynamics.inverse_dynamics(robot, q, qd, qdd)
    FD = dynamics.forward_dynamics(robot, q, qd, force)
    still = torch.zeros_like(q[0])
    for k in (0, batch - 1):
        assert relative(M[k], mirror.mass_matrix(q[k])) < EXACT
        assert relative(Q_G[k], mirror.gravity_force(q[k])) < EXACT
        assert relative(Q_G[k] + Q_C[k], -mirror.inverse_dynamics(q[k], qd[k], still)) < EXACT
        assert relative(ID[k], mirror.inverse_dynamics(q[k], qd[k], qdd[k])) < EXACT
        assert relative(FD[k], mirror.forward_dynamics(q[k], qd[k], force[k])) < rounding(M[k])


@pytest.mark.parametrize("seed", SEEDS)
def test_forward_dynamics_undoes_inverse_dynamics(seed: int) -> None:
    robot = random_robot(seed)
    q, qd, qdd, _ = random_states(robot, LARGE, seed)
    again = dynamics.forward_dynamics(robot, q, qd, dynamics.inverse_dynamics(robot, q, qd, qdd))
    assert relative(again, qdd) < rounding(dynamics.mass_matrix(robot, q))


@pytest.mark.parametrize("seed", SEEDS)
def test_columns_of_the_mass_matrix_are_inverse_dynamics(seed: int) -> None:
    robot = random_robot(seed).replace(gravity=torch.zeros(3, dtype=torch.float64))
    q = random_states(robot, 5, seed)[0]
    units = torch.eye(robot.nq, dtype=q.dtype)[:, None]
    columns = dynamics.inverse_dynamics(robot, q, torch.zeros_like(q), units)
    M = dynamics.mass_matrix(robot, q)
    assert relative(columns.movedim(0, -1), M) < EXACT
    assert torch.equal(M, M.mT)
    assert bool((torch.linalg.eigvalsh(M) > 0.0).all())


@pytest.mark.parametrize("seed", SEEDS)
def test_energy_grows_by_the_power_of_the_force(seed: int) -> None:
    """d/dt(T + V) = q̇·force along the motion: bias forces do no work, gravity's is the potential's."""
    robot = random_robot(seed)
    q, qd, _, force = random_states(robot, 6, seed)
    qdd = dynamics.forward_dynamics(robot, q, qd, force)

    def energy(q: Tensor, qd: Tensor) -> Tensor:
        return kinetic_energy(robot, q, qd) + potential_energy(robot, q)

    power = jvp(energy, (q, qd), (qd, qdd))[1]
    assert relative(power, (qd * force).sum(-1)) < 1e-9  # a difference of larger terms


@pytest.mark.parametrize("seed", SEEDS)
def test_bias_force_is_lagranges(seed: int) -> None:
    """Q_C = −Ṁ q̇ + ½ ∂(q̇ᵀ M q̇)/∂q, and Q_G = −∂V/∂q, by automatic differentiation."""
    robot = random_robot(seed)
    q, qd = (x[0] for x in random_states(robot, 1, seed)[:2])
    Mdot = jvp(lambda q: dynamics.mass_matrix(robot, q), (q,), (qd,))[1]
    lagrange = -Mdot @ qd + jacrev(lambda q: kinetic_energy(robot, q, qd))(q)
    assert relative(dynamics.bias_force(robot, q, qd), lagrange) < EXACT
    slope = jacrev(lambda q: potential_energy(robot, q))(q)
    assert relative(dynamics.gravity_force(robot, q), -slope) < EXACT


def quantities(robot: RobotModel) -> dict:
    return {
        "forward": lambda q, qd, f: dynamics.forward_dynamics(robot, q, qd, f),
        "inverse": lambda q, qd, f: dynamics.inverse_dynamics(robot, q, qd, f),
        "mass": lambda q, qd, f: dynamics.mass_matrix(robot, q),
    }


@pytest.mark.parametrize("name", ["forward", "inverse", "mass"])
def test_first_and_second_derivatives_at_zero_and_on_aligned_axes(name: str) -> None:
    robot = random_robot(3, nq=3, aligned=True)
    function = quantities(robot)[name]
    states = [torch.zeros(1, 3, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    assert torch.autograd.gradcheck(function, states)
    assert torch.autograd.gradgradcheck(function, states)


@pytest.mark.parametrize("name", ["forward", "inverse", "mass"])
def test_large_batches_have_the_derivatives_of_small_ones(name: str) -> None:
    robot = random_robot(1)
    function = quantities(robot)[name]
    states = [x.requires_grad_() for x in random_states(robot, LARGE, 1)[:3]]
    weight = torch.randn(function(*states)[0].shape, dtype=torch.float64)

    def gradient(states: list) -> list:
        found = torch.autograd.grad((function(*states) * weight).sum(), states, allow_unused=True)
        return [x for x in found if x is not None]

    all_at_once = gradient(states)
    one = gradient([x[:1].detach().requires_grad_() for x in states])
    for whole, single in zip(all_at_once, one, strict=True):
        assert relative(whole[:1], single) < 1e-9  # the same sums in another order, through M⁻¹


@pytest.mark.parametrize(
    "field",
    ["mass", "com", "inertia", "placement_position", "placement_rotation", "axis", "armature", "gravity"],
)
def test_derivatives_to_the_figures_of_the_robot(field: str) -> None:
    """Autograd against central differences, as θ_A is learned through the dynamics."""
    robot = random_robot(2, nq=4)
    q, qd, _, force = random_states(robot, 3, 2)
    value = getattr(robot, field)
    direction = torch.randn(value.shape, dtype=value.dtype, generator=torch.Generator().manual_seed(0))

    def total(step: float | Tensor) -> Tensor:
        moved = robot.replace(**{field: value + step * direction})
        return dynamics.forward_dynamics(moved, q, qd, force).square().sum()

    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    slope = torch.autograd.grad(total(step), step)[0]
    h = 1e-6
    central = (total(h) - total(-h)) / (2.0 * h)
    torch.testing.assert_close(
        slope, central, rtol=1e-6, atol=1e-7
    )  # truncation and rounding of the difference


@pytest.mark.parametrize("name", ["forward", "inverse", "mass"])
def test_function_transforms(name: str) -> None:
    robot = random_robot(5)
    function = quantities(robot)[name]
    states = random_states(robot, 4, 5)[:3]
    torch.testing.assert_close(vmap(function)(*states), function(*states), rtol=1e-12, atol=1e-12)
    reverse, forward = vmap(jacrev(function))(*states), vmap(jacfwd(function))(*states)
    torch.testing.assert_close(reverse, forward, rtol=1e-9, atol=1e-9)


def test_a_robot_can_be_used_again_after_a_transform() -> None:
    robot = random_robot(6)
    states = random_states(robot, 2, 6)[:3]
    inside = vmap(jacrev(quantities(robot)["forward"]))(*states)
    mass = robot.mass.clone().requires_grad_()
    learned = robot.replace(mass=mass)
    for _ in range(2):  # twice: nothing of the first graph may be kept
        torch.autograd.grad(quantities(learned)["forward"](*states).sum(), mass)
    assert torch.equal(vmap(jacrev(quantities(robot)["forward"]))(*states), inside)


@pytest.mark.parametrize("batch", [(), (0,), (1,), (2, 3), (0, 4)])
def test_batches_of_any_shape(batch: tuple[int, ...]) -> None:
    robot = random_robot(4)
    q, qd, f, _ = (x[: max(1, int(np.prod(batch)))] for x in random_states(robot, 12, 4))
    q, qd, f = (
        x[0] if batch == () else x[: int(np.prod(batch))].reshape(*batch, robot.nq) for x in (q, qd, f)
    )
    assert dynamics.mass_matrix(robot, q).shape == (*batch, robot.nq, robot.nq)
    result = dynamics.forward_dynamics(robot, q, qd, f)
    assert result.shape == (*batch, robot.nq)
    flat = dynamics.forward_dynamics(robot, *(x.reshape(-1, robot.nq) for x in (q, qd, f)))
    assert torch.equal(result.reshape(-1, robot.nq), flat)
    for energy in (potential_energy(robot, q), kinetic_energy(robot, q, qd)):
        assert energy.shape == batch


def test_batches_broadcast() -> None:
    robot = random_robot(4)
    q, qd, f, _ = random_states(robot, 3, 4)
    result = dynamics.forward_dynamics(robot, q[:, None], qd[0], f)
    assert result.shape == (3, 3, robot.nq)
    torch.testing.assert_close(
        result[2, 1], dynamics.forward_dynamics(robot, q[2], qd[0], f[1]), rtol=1e-9, atol=1e-9
    )


@pytest.mark.usefixtures("unchecked")
def test_wrong_shapes_are_named() -> None:
    robot = forcegp.load_robot("kuka_iiwa")
    q = torch.zeros(4, 7, dtype=torch.float64)
    with pytest.raises(
        ShapeError, match=r"force has the wrong shape for robot 'kuka_iiwa'(.|\n)*got: \(4, 6\)"
    ):
        dynamics.forward_dynamics(robot, q, q, q[:, :6])
    with pytest.raises(ShapeError, match=r"batch shapes of q, qd, force do not broadcast(.|\n)*qd \(3, 7\)"):
        dynamics.forward_dynamics(robot, q, q[:3], q)
    with pytest.raises(ShapeError, match=r"torch.float64 on cpu(.|\n)*hint: convert q"):
        dynamics.mass_matrix(robot, q.float())


@pytest.mark.parametrize("batch", [3, LARGE])
def test_single_precision(batch: int) -> None:
    robot = random_robot(7)
    q, qd, qdd, _ = random_states(robot, batch, 7)
    single = robot.to(dtype=torch.float32)
    found = dynamics.inverse_dynamics(single, q.float(), qd.float(), qdd.float())
    assert found.dtype == torch.float32
    assert (
        relative(found.double(), dynamics.inverse_dynamics(robot, q, qd, qdd)) < 1e-4
    )  # 2⁻²³ over the same sums
