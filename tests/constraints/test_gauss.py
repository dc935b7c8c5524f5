"""The constrained equations of motion: laws on random robots and states, and a dense KKT system."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import forcegp
from constraints.cases import CONSTRAINTS, SEEDS, chain, random_state, system_of
from forcegp.constraints import Baumgarte, ConstrainedSystem, Equations, Plane, SurfaceContact, project_state
from forcegp.errors import ForceGPError, ShapeError, UnknownNameError

LAW = 1e-10
"""Identities between products of four matrices with a mass matrix of condition up to 1e4, relative."""
KKT = 1e-9
"""Agreement with a dense solve, relative: the issue's figure."""

kinds = pytest.mark.parametrize("kind", list(CONSTRAINTS))
seeds = pytest.mark.parametrize("seed", SEEDS)


def case(kind: str, seed: int, n: int = 8) -> tuple[Equations, Tensor, Tensor]:
    """Equations, velocities and impressed forces."""
    system = system_of(kind, seed)
    q, qd, Q = random_state(system, n, seed=seed)
    return system.equations(q, qd), qd, Q


def times(X: Tensor, v: Tensor) -> Tensor:
    return (X @ v[..., None])[..., 0]


def close(a: Tensor, b: Tensor, tolerance: float = LAW) -> bool:
    return float((a - b).abs().max()) <= tolerance * max(1.0, float(b.abs().max()))


@kinds
@seeds
def test_T_and_P_are_oblique_projectors(kind: str, seed: int) -> None:
    eom, _, _ = case(kind, seed)
    assert close(eom.T @ eom.T, eom.T)
    assert close(eom.P @ eom.P, eom.P)
    assert torch.equal(eom.P, eom.T.mT)
    for X in (eom.T, eom.P):
        assert float((X - X.mT).abs().amax(dim=(-1, -2)).min()) > 1e-3, (
            "an oblique projector is not symmetric"
        )


@kinds
@seeds
def test_H_carries_forces_into_the_null_space_of_A(kind: str, seed: int) -> None:
    eom, _, _ = case(kind, seed)
    scale = float(eom.M_inv.abs().max()) * float(eom.A.abs().max())
    assert float((eom.A @ eom.H).abs().max()) < LAW * scale
    assert close(eom.H, eom.H.mT)
    assert close(eom.H, eom.T @ eom.M_inv)
    assert close(eom.H, eom.M_inv @ eom.P)
    singular = torch.linalg.svdvals(eom.H)
    rank = (singular > 1e-9 * singular[:, :1]).sum(-1)
    assert torch.equal(rank, eom.M.shape[-1] - eom.rank)
    assert torch.equal(eom.rank, torch.linalg.matrix_rank(eom.A, rtol=1e-9))


@kinds
@seeds
def test_accelerations_obey_the_constraint_and_newton(kind: str, seed: int) -> None:
    eom, _, Q = case(kind, seed)
    qdd, multiplier = eom.acceleration(Q), eom.multiplier(Q)
    assert close(times(eom.A, qdd), eom.b)
    assert close(times(eom.M, qdd), Q + times(eom.A.mT, multiplier))
    assert close(eom.constraint_force(Q), times(eom.A.mT, multiplier))
    assert close(qdd, times(eom.L, eom.b) + times(eom.H, Q))


@kinds
@seeds
def test_gauss_principle(kind: str, seed: int) -> None:
    """No admissible acceleration is closer in the M-norm to the free one (eq. 5)."""
    eom, _, Q = case(kind, seed)
    qdd, free = eom.acceleration(Q), eom.free_acceleration(Q)
    generator = torch.Generator().manual_seed(seed)
    admissible = times(eom.T, torch.randn(qdd.shape, generator=generator, dtype=torch.float64))
    assert close(times(eom.A, qdd + admissible), eom.b)

    def distance(x: Tensor) -> Tensor:
        return ((x - free) * times(eom.M, x - free)).sum(-1)

    for size in (1e-3, -1e-3, 1.0, -1.0):
        assert bool((distance(qdd + size * admissible) > distance(qdd)).all())


@kinds
@seeds
def test_constraint_forces_do_no_virtual_work(kind: str, seed: int) -> None:
    eom, qd, Q = case(kind, seed)
    Q_I = eom.constraint_force(Q)
    virtual = times(eom.T, qd)
    work = (Q_I * virtual).sum(-1).abs()
    assert float((work / (Q_I.norm(dim=-1) * virtual.norm(dim=-1))).max()) < LAW


def dense_kkt(eom: Equations, Q: Tensor, i: int, rows: Tensor) -> tuple[Tensor, Tensor]:
    """q̈ and Q_I of one sample from the saddle-point system over independent rows."""
    A, b, n = eom.A[i][rows], eom.b[i][rows], eom.M.shape[-1]
    K = torch.zeros(n + len(rows), n + len(rows), dtype=torch.float64)
    K[:n, :n], K[:n, n:], K[n:, :n] = eom.M[i], -A.T, A
    solved = torch.linalg.solve(K, torch.cat([Q[i], b]))
    return solved[:n], A.T @ solved[n:]


@kinds
@seeds
def test_against_a_dense_kkt_system(kind: str, seed: int) -> None:
    eom, _, Q = case(kind, seed)
    independent = torch.tensor([0, 2] if kind == "redundant" else list(range(eom.A.shape[-2])))
    qdd, Q_I = eom.acceleration(Q), eom.constraint_force(Q)
    for i in range(len(Q)):
        expected, force = dense_kkt(eom, Q, i, independent)
        assert close(qdd[i], expected, KKT)
        assert close(Q_I[i], force, KKT)


def test_redundant_rows_share_the_multiplier_and_the_rank_is_reported() -> None:
    eom, _, Q = case("redundant", 0)
    multiplier = eom.multiplier(Q)
    assert eom.rank.tolist() == [2] * len(Q)
    assert close(multiplier[:, 0], multiplier[:, 1], KKT)


CONSISTENT = 1e4
"""|A q̈ − b| in units of ε times the largest term of A q̈: the digits that M (condition 1e4) costs."""
FLANGE = "lbr_iiwa_link_7"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize(
    "normals", [((0, 0, 1),) * 3, ((0, 0, 1), (0, 0, -1), (0, 1, 0))], ids=["same", "opposed"]
)
def test_redundant_contacts_hold_in_both_precisions(dtype: torch.dtype, normals: tuple) -> None:
    """In single precision, three identical contacts once left |A q̈ − b| of 674 m/s² without an error."""
    robot = forcegp.load_robot("kuka_iiwa", dtype=dtype)
    point = (0.02, 0.01, 0.1)
    contacts = [SurfaceContact(f"{i}", FLANGE, point, Plane(normal)) for i, normal in enumerate(normals)]
    system = ConstrainedSystem(robot, contacts)
    q, qd, Q = (x.to(dtype) for x in random_state(system_of("two", 0), 200))
    eom = system.equations(q, qd)
    assert eom.rank.tolist() == [len({tuple(map(abs, normal)) for normal in normals})] * 200
    qdd = eom.acceleration(Q)
    error = times(eom.A, qdd) - eom.b
    terms = (eom.A.abs() @ qdd.abs()[..., None])[..., 0] + eom.b.abs()
    assert float((error / terms).abs().max()) < CONSISTENT * torch.finfo(dtype).eps
    exact = ConstrainedSystem(robot.to(dtype=torch.float64), contacts).equations(q.double(), qd.double())
    relative = (qdd - exact.acceleration(Q.double())).abs().max() / exact.acceleration(Q.double()).abs().max()
    assert float(relative) < CONSISTENT * torch.finfo(dtype).eps


def test_contacts_are_open_or_closed_sample_by_sample() -> None:
    system = system_of("two", 1)
    q, qd, Q = random_state(system, 4)
    active = torch.tensor([[True, True], [True, False], [False, True], [False, False]])
    eom = system.equations(q, qd, active)
    assert eom.rank.tolist() == [2, 1, 1, 0]
    qdd, multiplier = eom.acceleration(Q), eom.multiplier(Q)
    assert bool((multiplier[~active] == 0.0).all())
    for i, rows in enumerate(([0, 1], [0], [1], [])):
        expected, _ = dense_kkt(system.equations(q, qd), Q, i, torch.tensor(rows, dtype=torch.int64))
        assert close(qdd[i], expected, KKT)
    assert close(qdd[3], eom.free_acceleration(Q)[3])
    one = system.equations(q, qd, torch.tensor([True, False]))
    assert one.rank.tolist() == [1] * 4


def test_a_pin_opens_with_all_its_rows() -> None:
    system = system_of("pin", 0)
    q, qd, _ = random_state(system, 2)
    assert system.equations(q, qd, torch.tensor([[True], [False]])).rank.tolist() == [3, 0]


@pytest.mark.parametrize("batch", [(), (3,), (2, 3), (0,)])
def test_no_contacts_is_free_motion(batch: tuple[int, ...]) -> None:
    robot = chain(2)
    system = ConstrainedSystem(robot)
    q, qd, Q = random_state(system, *batch)
    eom = system.equations(q, qd)
    assert eom.A.shape == (*batch, 0, 7) and eom.L.shape == (*batch, 7, 0) and eom.rank.shape == batch
    assert eom.multiplier(Q).shape == (*batch, 0)
    if 0 not in batch:
        assert close(eom.acceleration(Q), torch.linalg.solve(eom.M, Q[..., None])[..., 0])
        assert close(eom.H, torch.linalg.inv(eom.M))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 7), st.booleans())
def test_laws_on_any_robot(seed: int, nq: int, aligned: bool) -> None:
    """Trees of any shape: where the tool cannot move along the normal the rank says so."""
    from random_robots import random_robot

    plane = SurfaceContact("plane", "tool", (0.1, 0.2, 0.0), Plane((0.1, -0.2, 1.0), 0.0))
    system = ConstrainedSystem(random_robot(seed, nq, aligned), [plane])
    q, qd, Q = random_state(system, 3, seed=seed)
    eom = system.equations(q, qd)
    reach = (eom.A * times(eom.M_inv, eom.A[:, 0])[:, None]).sum(-1)[:, 0]
    if float(reach.min()) < 1e-6:
        return
    assert close(eom.T @ eom.T, eom.T, 1e-7)
    assert close(times(eom.A, eom.acceleration(Q)), eom.b, 1e-7)
    assert close(times(eom.M, eom.acceleration(Q)), Q + eom.constraint_force(Q), 1e-7)


@pytest.mark.parametrize("kind", ["plane", "pin"])
def test_frictionless_constrained_motion_keeps_its_energy(kind: str) -> None:
    """Kinetic and potential energy along 0.1 s on the constraint, by RK4."""
    system = system_of(kind, 1)
    system = system.with_robot(system.robot.replace(gravity=0.3 * system.robot.gravity))
    q, qd, _ = random_state(system, seed=7)
    q, qd = project_state(system, q, 0.3 * qd)
    step, count = 2e-3, 50

    def rate(q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        eom = system.equations(q, qd)
        return qd, eom.acceleration(eom.Q_C + eom.Q_G)

    work = torch.zeros((), dtype=torch.float64)
    start = kinetic(system, q, qd)
    for _ in range(count):
        k1 = rate(q, qd)
        k2 = rate(q + 0.5 * step * k1[0], qd + 0.5 * step * k1[1])
        k3 = rate(q + 0.5 * step * k2[0], qd + 0.5 * step * k2[1])
        k4 = rate(q + step * k3[0], qd + step * k3[1])
        old = q
        q = q + step / 6.0 * (k1[0] + 2 * k2[0] + 2 * k3[0] + k4[0])
        qd = qd + step / 6.0 * (k1[1] + 2 * k2[1] + 2 * k3[1] + k4[1])
        # Simpson's rule over the step, by the force in the middle.
        forces = [forcegp.dynamics.gravity_force(system.robot, x) for x in (old, 0.5 * (old + q), q)]
        work = work + ((forces[0] + 4 * forces[1] + forces[2]) / 6.0 * (q - old)).sum()
    drift = abs(float(kinetic(system, q, qd) - start - work))
    assert drift < 1e-6 * max(1.0, float(kinetic(system, q, qd)))
    assert float(system.equations(q, qd).c.abs().max()) < 1e-6


def kinetic(system: ConstrainedSystem, q: Tensor, qd: Tensor) -> Tensor:
    return 0.5 * qd @ forcegp.dynamics.mass_matrix(system.robot, q) @ qd


def test_gradients_to_the_robot_match_central_differences() -> None:
    system = system_of("two", 0, Baumgarte())
    q, qd, Q = random_state(system, 3)
    weights = torch.randn(3, 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def value(**fields: Tensor) -> Tensor:
        eom = system.with_robot(system.robot.replace(**fields)).equations(q, qd)
        return (weights * eom.acceleration(Q + eom.Q_K)).sum() + eom.multiplier(Q + eom.Q_K).sum()

    for name in (
        "mass",
        "com",
        "inertia",
        "placement_position",
        "base_position",
        "gravity",
        "frame_position",
    ):
        x = getattr(system.robot, name)
        leaf = x.clone().requires_grad_()
        (found,) = torch.autograd.grad(value(**{name: leaf}), leaf)
        direction = torch.randn(x.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        if name == "inertia":
            direction = direction + direction.mT
        h = 1e-6
        difference = (value(**{name: x + h * direction}) - value(**{name: x - h * direction})) / (2 * h)
        error = abs(float((found * direction).sum() - difference))
        assert error < 1e-6 * float(found.norm() * direction.norm()), name


@pytest.mark.parametrize("kind", ["plane", "two", "pin", "implicit"])
def test_function_transforms(kind: str) -> None:
    """vmap over states equals the batch; jacrev and jacfwd equal central differences."""
    system = system_of(kind, 2)
    q, qd, Q = random_state(system, 3)

    def acceleration(q: Tensor, qd: Tensor, Q: Tensor) -> Tensor:
        return system.equations(q, qd).acceleration(Q)

    assert close(torch.func.vmap(acceleration)(q, qd, Q), acceleration(q, qd, Q), 1e-12)
    reverse = torch.func.vmap(torch.func.jacrev(acceleration))(q, qd, Q)
    h = 1e-6
    for j in range(7):
        step = h * torch.eye(7, dtype=torch.float64)[j]
        difference = (acceleration(q + step, qd, Q) - acceleration(q - step, qd, Q)) / (2 * h)
        assert close(reverse[..., j], difference, 1e-6)
    assert close(torch.func.jacfwd(acceleration)(q[0], qd[0], Q[0]), reverse[0])
    assert close(
        torch.func.jacrev(acceleration, argnums=2)(q[0], qd[0], Q[0]), system.equations(q[0], qd[0]).H
    )


def test_arguments_that_do_not_fit_are_refused() -> None:
    system = system_of("two", 0)
    q, qd, _ = random_state(system, 3)
    with pytest.raises(ShapeError, match=r"active does not match the contacts plane, ball[\s\S]*\(3, 2\)"):
        system.equations(q, qd, torch.ones(3, 1, dtype=torch.bool))
    with pytest.raises(ShapeError, match=r"expected: bool of shape \(3, 2\)[\s\S]*got: float64"):
        system.equations(q, qd, torch.ones(3, 2, dtype=torch.float64))
    with pytest.raises(ShapeError, match="active does not match"):
        system.equations(q, qd, torch.ones(4, 2, dtype=torch.bool))
    with pytest.raises(UnknownNameError, match=r"unknown contact 'plan'[\s\S]*did you mean 'plane'"):
        system.contact("plan")
    with pytest.raises(ForceGPError, match=r"two contacts are named 'plane'"):
        ConstrainedSystem(system.robot, [system.contacts[0], system.contacts[0]])


def test_the_summary_names_robot_and_contacts() -> None:
    robot = forcegp.load_robot("kuka_iiwa")
    system = ConstrainedSystem(robot, [SurfaceContact("table", FLANGE, (0, 0, 0.1), Plane())], Baumgarte())
    mass = f"{float(robot.mass.sum()):.4g} kg"
    assert repr(robot) == f"<RobotModel 'kuka_iiwa': 7 joints; {mass}; float64 on cpu>"
    assert repr(system) == f"<ConstrainedSystem: {robot!r}; SurfaceContact 'table'; {Baumgarte()!r}>"
    assert "no contacts>" in repr(ConstrainedSystem(robot))
