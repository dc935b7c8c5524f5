"""Methods of integration: order, agreement with each other and the simulator, energy, gradients."""

import math

import pytest
import torch

import forcegp
from forcegp.constraints import Baumgarte, ConstrainedSystem
from forcegp.errors import ModelError, UnknownNameError
from forcegp.rollout import RolloutOptions, rollout
from robots import kinetic_energy, potential_energy
from rollout_cases import ANALYTICAL, arm, on_manifold, simulated

SLOPE_TOLERANCE = 0.25
"""Of a measured order at steps that are small, not infinitely so."""
PYBULLET_TOLERANCE = 1e-5
"""One second of PyBullet steps, whose rounding the unstable open-loop motion multiplies [rad]."""

DIFFERENCE_STEP = 1e-7
"""Of central differences: motions that are unstable in open loop curve strongly within 1e−6."""


def smooth_torque(t: torch.Tensor, q: torch.Tensor, qd: torch.Tensor) -> torch.Tensor:
    return 0.3 * torch.sin(3.0 * t) - 0.2 * q - 0.1 * qd


def pendulum() -> tuple[ConstrainedSystem, torch.Tensor, torch.Tensor]:
    robot = forcegp.load_robot("double_pendulum")
    q0 = torch.tensor([0.7, -0.4], dtype=torch.float64)
    return ConstrainedSystem(robot), q0, torch.tensor([0.3, 0.5], dtype=torch.float64)


def end_state(method: str, dt: float) -> torch.Tensor:
    system, q0, qd0 = pendulum()
    found = rollout(
        ANALYTICAL, system, q0, qd0, smooth_torque, 0.2, options=RolloutOptions(dt=dt, method=method)
    )
    return torch.cat([found.q[-1], found.qd[-1]])


@pytest.mark.parametrize(("method", "order", "dt"), [("semi_implicit_euler", 1, 0.004), ("rk4", 4, 0.02)])
def test_convergence_is_of_the_method_s_order(method: str, order: int, dt: float) -> None:
    exact = end_state("dop853", 0.1)
    errors = [float((end_state(method, dt / 2**k) - exact).norm()) for k in range(3)]
    slopes = [math.log2(errors[k] / errors[k + 1]) for k in range(2)]
    assert slopes == pytest.approx([order, order], abs=SLOPE_TOLERANCE)


def test_adaptive_methods_agree() -> None:
    assert torch.allclose(end_state("rk45", 0.1), end_state("dop853", 0.05), atol=1e-7, rtol=0.0)


@pytest.mark.parametrize("method", ["rk4", "dop853"])
def test_frictionless_sliding_conserves_energy(method: str) -> None:
    """The constraint does no work, so without torque and friction the energy stays."""
    bare = arm()
    robot = bare.robot.replace(damping=torch.zeros_like(bare.robot.damping))
    system = bare.with_robot(robot)
    q0, qd0 = on_manifold(system, 1, speed=0.3)
    options = RolloutOptions(dt=0.002 if method == "rk4" else 0.05, method=method, stabilization="none")
    found = rollout(
        ANALYTICAL, system, q0, qd0, torch.zeros(1, 7, dtype=torch.float64), 0.15, options=options
    )
    energy = kinetic_energy(robot, found.q, found.qd) + potential_energy(robot, found.q)
    moved = kinetic_energy(robot, found.q, found.qd)
    assert float(moved.max() - moved.min()) > 0.1, "the motion exchanges energy"
    assert float((energy - energy[0]).abs().max()) < 1e-5, "fourth order at 500 Hz leaves microjoules"


def test_semi_implicit_euler_is_the_simulator() -> None:
    """Open loop under logged torques, the trajectory is PyBullet's own."""
    data = simulated().data
    n = 240
    found = rollout(ANALYTICAL, arm(Baumgarte()), data.q[0], data.qd[0], data, n / 240)
    assert float((found.q[:n] - data.q[:n]).abs().max()) < PYBULLET_TOLERANCE
    assert float((found.multiplier[:n, 0] - data.multiplier["table"][:n]).abs().max()) < 1e-3


def test_newtons_equation_holds_along_the_way() -> None:
    data, system = simulated().data, arm(Baumgarte())
    found = rollout(ANALYTICAL, system, data.q[0], data.qd[0], data, 0.2)
    eom = system.equations(found.q, found.qd)
    force = eom.Q_K + found.tau + (eom.A.mT @ found.multiplier[..., None])[..., 0]
    assert float(((eom.M @ found.qdd[..., None])[..., 0] - force).abs().max()) < 1e-9
    assert float(((eom.A @ found.qdd[..., None])[..., 0] - eom.b).abs().max()) < 1e-9


def test_a_batch_is_its_members() -> None:
    data, system = simulated().data, arm(Baumgarte())
    rows = torch.tensor([0, 40, 80])
    q0, qd0 = data.q[rows].reshape(1, 3, 7), data.qd[rows].reshape(1, 3, 7)
    tau = torch.stack([data.tau[r : r + 50] for r in rows.tolist()])[None]
    options = RolloutOptions(dt=1.0 / 240.0)
    together = rollout(ANALYTICAL, system, q0, qd0, tau, 0.1, options=options)
    assert together.q.shape == (1, 3, 25, 7)
    for i in range(3):
        alone = rollout(ANALYTICAL, system, q0[0, i], qd0[0, i], tau[0, i], 0.1, options=options)
        assert torch.allclose(together.q[0, i], alone.q, atol=1e-10, rtol=0.0)


def check_gradients(loss, inputs: list[torch.Tensor]) -> None:
    """Compare gradients along random directions with central differences."""
    leaves = [x.clone().requires_grad_() for x in inputs]
    gradients = torch.autograd.grad(loss(*leaves), leaves)
    generator = torch.Generator().manual_seed(0)
    for i, gradient in enumerate(gradients):
        direction = torch.randn(inputs[i].shape, dtype=torch.float64, generator=generator)
        ends = []
        for step in (DIFFERENCE_STEP, -DIFFERENCE_STEP):
            moved = [x + step * direction if j == i else x for j, x in enumerate(inputs)]
            with torch.no_grad():
                ends.append(float(loss(*moved)))
        difference = (ends[0] - ends[1]) / (2.0 * DIFFERENCE_STEP)
        assert float((gradient * direction).sum()) == pytest.approx(difference, rel=1e-4, abs=1e-6)


def test_gradients_of_one_second_in_contact_match_differences() -> None:
    """With respect to the initial state, the torques and a figure of the robot."""
    plain, data = arm(Baumgarte()), simulated().data
    options = RolloutOptions(dt=1.0 / 120.0)

    def loss(q: torch.Tensor, qd: torch.Tensor, tau: torch.Tensor, mass: torch.Tensor) -> torch.Tensor:
        system = plain.with_robot(plain.robot.replace(mass=mass))
        found = rollout(ANALYTICAL, system, q, qd, tau, 1.0, options=options)
        return found.tip("lbr_iiwa_link_7", (0.0, 0.0, 0.1))[-1].sum() + 1e-2 * found.multiplier.mean()

    check_gradients(loss, [data.q[0], data.qd[0], data.tau[:240:2], plain.robot.mass])


def test_gradients_through_runge_kutta_match_differences() -> None:
    system, q0, qd0 = pendulum()
    generator = torch.Generator().manual_seed(1)
    tau = 0.1 * torch.randn(20, 2, dtype=torch.float64, generator=generator)
    options = RolloutOptions(dt=0.05, method="rk4", interpolation="linear")

    def loss(q: torch.Tensor, qd: torch.Tensor, tau: torch.Tensor, mass: torch.Tensor) -> torch.Tensor:
        moved = system.with_robot(system.robot.replace(mass=mass))
        return rollout(ANALYTICAL, moved, q, qd, tau, 1.0, options=options).q[-1].sum()

    check_gradients(loss, [q0, qd0, tau, system.robot.mass])


def test_adaptive_methods_refuse_gradients() -> None:
    system, q0, qd0 = pendulum()
    with pytest.raises(ModelError, match="DOP853"):
        rollout(
            ANALYTICAL,
            system,
            q0.requires_grad_(),
            qd0,
            smooth_torque,
            0.1,
            options=RolloutOptions(method="dop853"),
        )


def test_unknown_methods_are_named() -> None:
    with pytest.raises(UnknownNameError, match="semi_implicit_euler, rk4"):
        RolloutOptions(method="rk5")
