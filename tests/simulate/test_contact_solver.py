"""MuJoCo's contact solver: its forces obey Newton's and Coulomb's laws, and sensors do what they are told."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch

from forcegp import ConstrainedSystem, SurfaceContact, load_robot
from forcegp.constraints import Baumgarte, Cylinder, ImplicitSurface, PointConnection, Sphere
from forcegp.errors import ForceGPError
from forcegp.scene import load_scene
from forcegp.simulate import ContactSolver, Sensors, SimulationConfig, SimulationResult, simulate

pytest.importorskip("mujoco")

SCENE = load_scene("ur5_wiping")
SYSTEM = SCENE.system()
NEWTON = 1e-4
"""Residual of the solver's iteration at large friction forces, as an acceleration [rad/s²]."""
CONE = 1e-3
"""Regularization of the friction cone, relative to the normal force."""
PENETRATION = 3e-4
"""What the stiff but not rigid contact gives way under some tens of newtons [m]."""


@cache
def wiping() -> SimulationResult:
    return simulate(SYSTEM, replace(SCENE.simulation, duration=1.6, lift_probability=0.0))


def test_newtons_equation_holds_with_the_solver_s_forces() -> None:
    data = wiping().data
    eom = SYSTEM.equations(data.q, data.qd)
    force = data.Q + data.Q_I + data.Q_z
    qdd = torch.linalg.solve(eom.M, force[..., None])[..., 0]
    assert float((qdd - data.qdd_clean).abs().max()) < NEWTON
    assert wiping().acceleration_mismatch < NEWTON


@pytest.mark.parametrize("drag", [0.0, 2.0])
def test_the_acceleration_is_that_of_the_engines_motion(drag: float) -> None:
    """Also for a wrist whose viscous friction slows it within one step of the engine: h D/M = 0.6."""
    from forcegp.simulate.contact_solver import ContactSolverEngine

    h = 5e-4
    robot = SYSTEM.robot.replace(drag=torch.full_like(SYSTEM.robot.axis[:, :2], drag))
    engine = ContactSolverEngine(SYSTEM.with_robot(robot), h, replace(SCENE.simulation.solver, step=h))
    data = wiping().data
    for row in range(0, len(data), 50):
        engine.reset(data.q[row], data.qd[row])
        qdd = torch.from_numpy(engine.forces(data.tau[row].numpy()).qdd)
        engine.step()
        torch.testing.assert_close((engine.state()[1] - data.qd[row]) / h, qdd, rtol=1e-6, atol=1e-6)


def test_forces_of_the_contact_are_normal_tangential_and_within_the_cone() -> None:
    data = wiping().data
    closed, multiplier = data.contact["table"], data.multiplier["table"]
    assert float(closed.double().mean()) > 0.9
    normal, friction = data.F_I["table"], data.F_z["table"]
    assert float(normal[:, :2].abs().max()) < 1e-9 and float(friction[:, 2].abs().max()) < 1e-9
    torch.testing.assert_close(normal[:, 2], multiplier)
    ratio = friction.norm(dim=-1)[closed] / multiplier[closed]
    assert float(ratio.max()) < SCENE.simulation.solver.friction + CONE
    sliding = wiping().velocity.norm(dim=-1)[closed] > 0.05
    assert float(ratio[sliding].median()) == pytest.approx(SCENE.simulation.solver.friction, rel=0.01)
    power = (friction * wiping().velocity).sum(-1)
    assert float(power[closed][sliding].max()) < 0.0


def test_our_multiplier_explains_the_solver_s_force_once_friction_is_known() -> None:
    """The soft contact settles within a fraction of a second; from there on it is nearly rigid."""
    data = wiping().data[100:]
    eom, closed = SYSTEM.equations(data.q, data.qd), data.contact["table"]
    known = (eom.multiplier(data.Q + data.Q_z)[:, 0] - data.multiplier["table"])[closed]
    assert float(known.abs().quantile(0.9)) < 0.2
    undeclared = (eom.multiplier(data.tau + eom.Q_K)[:, 0] - data.multiplier["table"])[closed]
    assert float(undeclared.abs().quantile(0.9)) > 3.0, "the robot file does not declare the friction"
    assert float(eom.c[closed].abs().max()) < PENETRATION


def test_joint_friction_is_dry_and_viscous() -> None:
    data, solver = wiping().data, SCENE.simulation.solver
    eom = SYSTEM.equations(data.q, data.qd)
    friction = data.Q - eom.Q_K - data.tau
    dt = SCENE.simulation.dt
    end = data.qd + dt / solver.substeps(dt) * data.qdd_clean  # viscous friction is that of the step's end
    expected = -torch.tensor(solver.joint_friction) * data.qd.sign()
    expected = expected - torch.tensor(solver.joint_damping) * end
    moving = data.qd.abs() > 0.1
    # Where a joint comes to rest within a step the solver lets it stick, so a few rows may differ.
    apart = (friction - expected).abs()[moving]
    assert float(apart.quantile(0.9)) < 0.05
    assert bool((friction.abs() <= expected.abs() + torch.tensor(solver.joint_friction) + 1e-6).all())


@pytest.mark.parametrize(
    "surface", [Sphere((0.45, 0.15, -0.45), 0.5), Cylinder((0.45, 0.0, -0.35), (0, 1, 0), 0.4)]
)
def test_curved_surfaces(surface: Sphere | Cylinder) -> None:
    contact = SurfaceContact("ball", "tool", (0.0, 0.0, 0.1), surface)
    system = ConstrainedSystem(SYSTEM.robot, [contact], Baumgarte())
    config = replace(SCENE.simulation, duration=0.6, size=(0.1, 0.1), lift_probability=0.0, travel_time=0.5)
    result = simulate(system, config)
    data, closed = result.data, result.data.contact["ball"]
    assert float(closed.double().mean()) > 0.9
    normal = torch.nn.functional.normalize(data.F_I["ball"][closed], dim=-1)
    # The force acts where the rounded tip touches, the gradient is taken at the contact point.
    cosine = (normal * surface.gradient(result.position[closed])).sum(-1)
    assert float(cosine.min()) > 0.999
    assert float(result.c[closed].abs().max()) < 2.0 * PENETRATION


def test_sensors_round_delay_and_add_noise() -> None:
    sensors = Sensors(encoder_resolution=1e-3, velocity_noise=0.01, torque_noise=0.2, torque_delay=0.008)
    data = simulate(SYSTEM, replace(SCENE.simulation, duration=0.8, sensors=sensors)).data
    steps = data.q / 1e-3
    assert float((steps - steps.round()).abs().max()) < 1e-6
    assert 0.0 < float((data.q - data.q_clean).abs().max()) <= 0.5e-3 + 1e-12
    assert float((data.qd - data.qd_clean).std()) == pytest.approx(0.01, rel=0.1)
    late = data.tau[2:] - data.tau_clean[:-2]
    assert float(late.std()) == pytest.approx(0.2, rel=0.1)
    perfect = wiping().data
    assert "q_clean" not in perfect.extras


def test_the_seed_decides() -> None:
    sensors = Sensors(velocity_noise=0.01)
    config = replace(SCENE.simulation, duration=0.1, sensors=sensors)
    first, again = (simulate(SYSTEM, config).data for _ in range(2))
    assert torch.equal(first.q, again.q) and torch.equal(first.qd, again.qd)


def test_what_the_solver_cannot_do_is_named() -> None:
    config = replace(SCENE.simulation, duration=0.1)
    held = PointConnection("hook", "tool", (0.0, 0.0, 0.1), None, (0.45, 0.15, 0.05))
    with pytest.raises(ForceGPError, match="no geometry for the constraint 'hook'"):
        simulate(ConstrainedSystem(SYSTEM.robot, [held]), config)
    bumpy = SurfaceContact("bump", "tool", (0.0, 0.0, 0.1), ImplicitSurface(lambda p: p[2] - 0.05))
    with pytest.raises(ForceGPError, match="no geometry for the surface of 'bump'"):
        simulate(ConstrainedSystem(SYSTEM.robot, [bumpy]), config)
    with pytest.raises(ForceGPError, match=r"joint_friction has the wrong length(.|\n)*6 numbers"):
        simulate(SYSTEM, replace(config, solver=ContactSolver(joint_friction=(1.0, 2.0))))


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"contact": "soft"}, "contact"),
        ({"contact": "solver", "engine": "pybullet"}, "engine"),
    ],
)
def test_settings_that_do_not_fit_are_named(settings: dict, name: str) -> None:
    with pytest.raises(ForceGPError, match=f"{name} is out of range"):
        SimulationConfig(**settings)


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (ContactSolver, {"tip_radius": 0.0}),
        (ContactSolver, {"friction": -1.0}),
        (ContactSolver, {"joint_friction": (1.0, -1.0)}),
        (Sensors, {"torque_delay": float("nan")}),
    ],
)
def test_solver_and_sensor_settings_are_checked(kind: type, settings: dict) -> None:
    with pytest.raises(ForceGPError, match=next(iter(settings))):
        kind(**settings)


def test_the_arm_is_the_published_one() -> None:
    """The mass of its links and the tool."""
    robot = load_robot("ur5")
    assert robot.nq == 6
    total = float(robot.mass.sum())
    assert total == pytest.approx(3.7 + 8.393 + 2.275 + 2 * 1.219 + 0.1879 + 0.5)
