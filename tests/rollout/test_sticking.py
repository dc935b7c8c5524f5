"""Joints that stick: against MuJoCo's friction loss, closed forms, and the conditions of the problem."""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import forcegp
from forcegp.forces.priors.contact import SlidingFrictionPrior
from forcegp.forces.priors.joint import AnalyticalMean
from forcegp.gp.kernels import Linear
from forcegp.rollout import DivergedError, ForceLaw, RolloutOptions, rollout
from forcegp.rollout.law import dry_friction_force
from slow import slow_except

LIMITS = (2.0, 0.7)
DT = 2e-3
DOUBLE = f"""
<mujoco><compiler angle="radian"/><option timestep="{DT}" integrator="Euler" iterations="200"
    tolerance="1e-12">
  <flag eulerdamp="disable"/></option>
  <default><joint type="hinge" axis="0 1 0" solimpfriction="0.99999 0.99999 0.001"
    solreffriction="{2 * DT} 1"/></default>
  <worldbody><body><joint name="shoulder" frictionloss="{LIMITS[0]}"/>
    <inertial pos="0 0 -0.5" mass="1" diaginertia="0.0834 0.0834 0.0002"/>
    <body pos="0 0 -1"><joint name="elbow" frictionloss="{LIMITS[1]}"/>
      <inertial pos="0 0 -0.5" mass="1" diaginertia="0.0834 0.0834 0.0002"/>
    </body></body></worldbody></mujoco>
"""
TOLERANCE = {"semi_implicit_euler": 1e-4, "rk4": 2.0 * DT}
"""The same step as MuJoCo's, up to its compliance; another method up to that step's order [rad, rad/s]."""
ANALYTICAL = ForceLaw(AnalyticalMean())


@pytest.fixture
def pendulum(tmp_path: Path) -> forcegp.ConstrainedSystem:
    """Two links with dry friction in both joints, hanging along −z."""
    path = tmp_path / "double.xml"
    path.write_text(DOUBLE)
    return forcegp.ConstrainedSystem(forcegp.load_robot(path))


def in_mujoco(q0: Tensor, qd0: Tensor, tau: Tensor, xml: str = DOUBLE) -> tuple[Tensor, Tensor]:
    """Position and velocity before each step under torques `(steps, 2)`."""
    model = mujoco.MjModel.from_xml_string(xml)  # pyright: ignore[reportAttributeAccessIssue]
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    data.qpos[:], data.qvel[:] = q0, qd0
    states = []
    for torque in tau.numpy():
        states.append((data.qpos.copy(), data.qvel.copy()))
        data.qfrc_applied[:] = torque
        mujoco.mj_step(model, data)  # pyright: ignore[reportAttributeAccessIssue]
    q, qd = (torch.from_numpy(np.stack(part)) for part in zip(*states, strict=True))
    return q, qd


def rolled(system: forcegp.ConstrainedSystem, q0: Tensor, qd0: Tensor, tau: Tensor, **options):
    settings = RolloutOptions(dt=DT, **options)
    return rollout(ANALYTICAL, system, q0, qd0, tau, DT * (len(tau) - 1), options=settings)


def pair(first: float, second: float) -> Tensor:
    return torch.tensor([first, second], dtype=torch.float64)


@pytest.mark.parametrize("method", slow_except(["semi_implicit_euler", "rk4"], "semi_implicit_euler"))
def test_a_ramp_breaks_a_joint_away_where_it_does_in_mujoco(pendulum, method: str) -> None:
    """The torque of the shoulder rises through its limit; the elbow sticks on for a while."""
    tau = torch.zeros(300, 2, dtype=torch.float64)
    tau[:, 0] = torch.linspace(0.0, 3.0, 300, dtype=torch.float64)
    q, qd = in_mujoco(pair(0, 0), pair(0, 0), tau)
    found = rolled(pendulum, pair(0, 0), pair(0, 0), tau, method=method)
    first = int((found.qd[:, 0] != 0.0).double().argmax())
    assert first == pytest.approx(2.0 / 3.0 * 299, abs=2), "where the ramp reaches 2 N m, and not before"
    assert float(qd[-1].abs().max()) > 0.03
    assert float((found.q - q).abs().max()) < TOLERANCE[method]
    assert float((found.qd - qd).abs().max()) < TOLERANCE[method]


@pytest.mark.parametrize("method", ["semi_implicit_euler", pytest.param("rk4", marks=pytest.mark.slow)])
def test_both_joints_come_to_rest_where_they_do_in_mujoco(pendulum, method: str) -> None:
    tau = torch.zeros(450, 2, dtype=torch.float64)
    tau[:100, 0], tau[50:120, 1] = 4.0, -1.5
    q, qd = in_mujoco(pair(0.0, 0.05), pair(0.4, -1.0), tau)
    found = rolled(pendulum, pair(0.0, 0.05), pair(0.4, -1.0), tau, method=method)
    assert float(qd[-1].abs().max()) < 1e-4 and float(qd[1:].abs().amax()) > 0.3
    assert not bool(found.qd[-1].any()), "at rest, exactly"
    assert float((found.q - q).abs().max()) < TOLERANCE[method]


def test_smooth_friction_lets_a_joint_creep_that_dry_friction_holds(pendulum) -> None:
    tau = torch.zeros(50, 2, dtype=torch.float64)
    q0 = pair(0.1, 0.0)  # the weight of the two links at 0.1 rad is 1.96 N m, of the second 0.49 N m
    held = rolled(pendulum, q0, pair(0, 0), tau)
    assert torch.equal(held.q, q0.expand_as(held.q))
    assert not bool(held.qdd.any())
    creeping = rolled(pendulum, q0, pair(0, 0), tau, sticking=False)
    assert float((creeping.q[-1] - q0).abs().max()) > 1e-3


def test_stiff_viscous_friction_is_that_of_mujocos_implicit_step(pendulum) -> None:
    """A damper that an explicit step would turn round: h D/I = 4.8; MuJoCo takes it at the step's end."""
    damping = (1.0, 200.0)
    xml = DOUBLE.replace('<flag eulerdamp="disable"/>', "")
    for limit, own in zip(LIMITS, damping, strict=True):
        xml = xml.replace(f'frictionloss="{limit}"', f'damping="{own}"')
    tau = torch.zeros(300, 2, dtype=torch.float64)
    tau[:, 0] = 2.0 * torch.sin(torch.arange(300.0) / 30.0)
    q0, qd0 = pair(0.3, -0.5), pair(0.2, 1.0)
    q, qd = in_mujoco(q0, qd0, tau, xml)
    robot = pendulum.robot.replace(damping=pair(*damping), friction=pair(1e-9, 1e-9))
    found = rolled(dataclasses.replace(pendulum, robot=robot), q0, qd0, tau)
    assert float((found.q - q).abs().max()) < 1e-7
    assert float((found.qd - qd).abs().max()) < 1e-7
    with pytest.raises(DivergedError):
        rolled(dataclasses.replace(pendulum, robot=robot), q0, qd0, tau, sticking=False)


def test_a_block_in_contact_slides_to_rest_in_closed_form(tmp_path: Path) -> None:
    """A guide with dry friction F: the block stops after m v²/2F, and holds against less than F."""
    from rollout_cases import slider

    system = slider(tmp_path)
    robot = system.robot.replace(friction=pair(6.0, 0.0))
    system = dataclasses.replace(system, robot=robot)
    push = torch.zeros(200, 2, dtype=torch.float64)
    push[120:160, 0], push[160:, 0] = 5.9, 6.6
    options = RolloutOptions(dt=DT, unilateral=True)
    found = rollout(ANALYTICAL, system, pair(0, 0), pair(0.4, 0), push, 0.398, options=options)
    mass = 3.0  # at rest after m v/F = 0.2 s
    assert float(found.q[150, 0]) == pytest.approx(mass * 0.4**2 / 12.0, abs=0.4 * DT)
    assert not bool(found.qd[101:160].any())
    assert float(found.qd[-1, 0]) == pytest.approx(0.6 / mass * 0.078, rel=1e-6)
    assert not found.events and float(found.multiplier.min()) > 0.0


def test_an_arm_pressed_on_a_table_holds_still() -> None:
    """Seven joints stick in contact, where only six can move: the arm rests, and the table carries it."""
    from forcegp.constraints import project_state
    from rollout_cases import arm, simulated

    system = arm()
    robot = system.robot.replace(friction=torch.full_like(system.robot.mass, 5.0))
    system = dataclasses.replace(system, robot=robot)
    q, _ = project_state(system, simulated().data.q[50], torch.zeros(7, dtype=torch.float64))
    eom = system.equations(q, 0 * q)
    hold = -eom.Q_G + (eom.A.mT @ torch.tensor([[-20.0]], dtype=torch.float64))[:, 0]
    still = rollout(ANALYTICAL, system, q, 0 * q, lambda t, q, qd: hold, 0.1)
    assert float(still.qd.abs().max()) < 1e-9
    gone = rollout(ANALYTICAL, system, q, 0 * q, lambda t, q, qd: hold + 6.0, 0.05)
    assert float(gone.qd[-1].abs().max()) > 1e-3


def test_stopping_a_joint_adds_no_energy_to_the_others(pendulum) -> None:
    """Runge-Kutta leaves a stopping joint with a part of its speed, which the others feel as it goes."""
    system = dataclasses.replace(pendulum, robot=pendulum.robot.replace(gravity=torch.zeros(3).double()))
    generator = torch.Generator().manual_seed(0)
    q0 = 3.0 * torch.randn(200, 2, generator=generator, dtype=torch.float64)
    qd0 = 2.0 * torch.randn(200, 2, generator=generator, dtype=torch.float64)
    options = RolloutOptions(dt=0.02, method="rk4")
    found = rollout(ANALYTICAL, system, q0, qd0, lambda t, q, qd: torch.zeros_like(q), 0.2, options=options)
    M = forcegp.dynamics.mass_matrix(system.robot, found.q)
    energy = 0.5 * (found.qd[..., None, :] @ M @ found.qd[..., None])[..., 0, 0]
    stopped = ((found.qd[:, 1:] == 0.0) & (found.qd[:, :-1] != 0.0)).any(-1)
    assert int(stopped.sum()) > 50
    assert float(energy.diff(dim=1)[stopped].max()) <= 1e-6 * float(energy.max())


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31 - 1), st.sampled_from([0.0, 1e-4, 1e-2]))
def test_friction_opposes_as_much_as_it_can(seed: int, h: float) -> None:
    """|p| ≤ F; p = −F sign(q̇⁺) where a joint slides; q̇⁺ = 0 where |p| < F; with singular G as in contact."""
    generator = torch.Generator().manual_seed(seed)
    W = torch.randn(40, 7, 7, dtype=torch.float64, generator=generator)
    W[20:, :, 0] = 0.0
    scale = torch.logspace(-1, 1.5, 7, dtype=torch.float64)
    G = (scale * (W @ W.mT)).mT * scale
    range_of = G @ torch.randn(40, 7, 1, dtype=torch.float64, generator=generator)
    qdd, limit = range_of[..., 0], torch.rand(40, 7, dtype=torch.float64, generator=generator)
    qd = 1e-3 * (G @ torch.randn(40, 7, 1, dtype=torch.float64, generator=generator))[..., 0]
    qd[::3] = 0.0
    force, held, _ = dry_friction_force(qdd, G, limit, qd, torch.full((40, 1), h, dtype=torch.float64))
    after = qdd + (G @ force[..., None])[..., 0] + qd / max(h, 1e-12)
    size = after.abs() + qdd.abs() + qd.abs() / max(h, 1e-12) + (G.abs() @ limit[..., None])[..., 0]
    moving = after.abs() > 1e-6 * size
    assert bool((force.abs() <= limit * (1.0 + 1e-6) + 1e-6).all())
    assert bool((after[held].abs() <= 1e-6 * size[held]).all())
    assert torch.allclose(force[moving], (-limit * after.sign())[moving])


@pytest.mark.slow
def test_a_learned_friction_sticks_as_the_true_one_does(pendulum) -> None:
    """A robot file without friction, a log of MuJoCo's motion with it: where the fit breaks away."""
    generator = torch.Generator().manual_seed(1)
    n = 6000
    t, torque = DT * torch.arange(n, dtype=torch.float64), torch.zeros(n, 2, dtype=torch.float64)
    for joint, size in enumerate((9.0, 3.0)):
        rate, phase = torch.rand(2, 6, dtype=torch.float64, generator=generator)
        tones = torch.sin(2.0 * torch.pi * ((0.2 + 1.3 * rate) * t[:, None] + phase))
        torque[:, joint] = size * tones.sum(-1) / 6.0**0.5
    q, qd = in_mujoco(pair(0, 0), pair(0, 0), torque)
    qdd = qd.diff(dim=0) / DT + 0.05 * torch.randn(n - 1, 2, dtype=torch.float64, generator=generator)
    rows = torch.arange(0, n - 1, 8)
    robot = pendulum.robot.replace(friction=pair(0, 0))
    log = forcegp.Dataset(
        t=t[rows], q=q[rows], qd=qd[rows], qdd=qdd[rows], tau=torque[rows], joint_names=robot.joint_names
    )
    fit = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot), "analytical").fit(log)
    ramp = torch.zeros(300, 2, dtype=torch.float64)
    ramp[:, 0] = torch.linspace(0.0, 3.0, 300, dtype=torch.float64)
    truth, _ = in_mujoco(pair(0, 0), pair(0, 0), ramp)
    options = RolloutOptions(dt=DT, torque_noise=False)
    path = fit.rollout(pair(0, 0), pair(0, 0), ramp, DT * 299, samples=10, options=options)
    assert path.samples is not None
    assert int((path.qd[:, 0] != 0.0).double().argmax()) == pytest.approx(200, abs=5)
    assert float((path.q - truth).abs().max()) < 1e-3
    breaks = (path.samples.qd[..., 0] != 0.0).double().argmax(-1).double()
    assert float((breaks - 200.0).abs().max()) < 20.0


MASS, MU, GRAVITY = 2.0, 0.4, 9.81
BLOCK = f"""
<mujoco><worldbody><body><inertial pos="0 0 0" mass="{MASS}" diaginertia="0.01 0.01 0.01"/>
  <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
</body></worldbody></mujoco>
"""


@pytest.fixture
def block(tmp_path: Path) -> forcegp.ConstrainedSystem:
    """A block that slides along x and z, on a table at z = 0, where it may stick."""
    path = tmp_path / "block.xml"
    path.write_text(BLOCK)
    robot = forcegp.load_robot(path)
    foot = forcegp.SurfaceContact(
        "foot", robot.frame_names[-1], (0.0, 0.0, 0.0), forcegp.Plane(offset=0.0), stick_speed=1e-3
    )
    return forcegp.ConstrainedSystem(robot, [foot])


def test_a_block_slides_where_the_push_leaves_its_friction_cone(block) -> None:
    """Pushed by 0.95 μ m g it rests, by 1.25 μ m g it slides by ¼ μ g t²/2, and released it stops."""
    n = 400
    generator = torch.Generator().manual_seed(0)
    weight = MASS * GRAVITY
    qd, push = torch.zeros(2, n, 2, dtype=torch.float64)
    qd[:, 0] = 0.5 * torch.randn(n, generator=generator, dtype=torch.float64)
    push[:, 0] = weight * torch.randn(n, generator=generator, dtype=torch.float64)
    qdd = torch.zeros_like(qd)
    qdd[:, 0] = push[:, 0] / MASS - MU * GRAVITY * torch.tanh(qd[:, 0] / 1e-9)
    slides = qd[:, 0].abs() > 0.05
    log = forcegp.Dataset(
        t=torch.arange(int(slides.sum()), dtype=torch.float64),
        q=0.0 * qd[slides],
        qd=qd[slides],
        qdd=qdd[slides] + 1e-3 * torch.randn(int(slides.sum()), 2, generator=generator, dtype=torch.float64),
        tau=push[slides],
        joint_names=block.robot.joint_names,
        contact={"foot": torch.ones(int(slides.sum()), dtype=torch.bool)},
    )
    prior = SlidingFrictionPrior("foot", Linear(), coupled=True)
    fit = forcegp.StructuredGP(block, "analytical", force_priors=[prior], noise=1e-3).fit(log)
    dt, each = 5e-3, 80
    steps = torch.tensor([[0.95], [1.25], [0.0]], dtype=torch.float64).repeat_interleave(each, dim=0)
    pushes = torch.cat([steps * MU * weight, torch.zeros_like(steps)], dim=-1)
    options = RolloutOptions(dt=dt)
    path = fit.rollout(pair(0, 0), pair(0, 0), pushes, dt * (3 * each - 1), options=options)
    speeds, speed = path.qd[:, 0], 0.25 * MU * GRAVITY * dt * each
    assert float(speeds[:each].abs().max()) < 1e-6
    assert float(path.multiplier[:each, 1].abs().max()) == pytest.approx(0.95 * MU * weight, rel=1e-6)
    assert float(speeds[2 * each]) == pytest.approx(speed, rel=0.03)
    # v/(μ g) after the push ends
    stopped = 2 * each + int((speeds[2 * each :] < 1e-3).double().argmax())
    assert stopped == pytest.approx(2 * each + speed / (MU * GRAVITY) / dt, abs=2)
    assert float(speeds[stopped:].abs().max()) < 1e-3


def test_friction_is_found_where_exchanging_joints_goes_round_in_circles() -> None:
    """In contact with Coulomb friction the response is asymmetric; two of three joints are nearly at rest."""
    G = [[5.6159, 1.3711, -1.2225], [-0.21329, -0.051675, -0.0054935], [0.18167, -0.2473, 37.804]]
    G = torch.tensor(G, dtype=torch.float64)
    limit = torch.tensor([0.5052, 0.8354, 0.2852], dtype=torch.float64)
    free = torch.tensor([-262.0699, 10.6164, -0.6146], dtype=torch.float64)
    still, h = torch.zeros(1, 3, dtype=torch.float64), torch.full((1, 1), 0.0025, dtype=torch.float64)
    force, held, _ = dry_friction_force(free[None], G[None], limit[None], still, h)
    motion = free + G @ force[0]
    assert held[0].tolist() == [False, False, True] and float(motion[2].abs()) < 1e-5
    assert bool((force[0].abs() <= limit + 1e-9).all())
    torch.testing.assert_close(force[0, :2], -motion[:2].sign() * limit[:2])


@pytest.mark.parametrize("dt", [1e-2, 5e-3])
def test_a_motion_and_its_mirror_image_are_the_same(dt: float) -> None:
    """Light links with friction that falls with the speed: damping acts at the end of a step."""
    robot = forcegp.load_robot("double_pendulum")
    one = torch.ones_like(robot.friction)
    robot = robot.replace(mass=0.02 * robot.mass, inertia=0.02 * robot.inertia, damping=0.02 * one)
    robot = robot.replace(friction=0.05 * one, stribeck=0.5 * one, stribeck_velocity=0.05 * one)
    fit = forcegp.AnalyticalModel(forcegp.ConstrainedSystem(robot)).nominal()
    start = pair(0.3, 0.2), pair(0.5, 0.3)

    def swing(sign: float) -> Tensor:
        def push(t: float, q: Tensor, qd: Tensor) -> Tensor:
            return sign * pair(0.9, 0.6) * torch.cos(torch.as_tensor(6.0 * t, dtype=q.dtype))

        return fit.rollout(*(sign * x for x in start), push, 0.5, options=RolloutOptions(dt=dt)).q

    assert torch.allclose(swing(1.0), -swing(-1.0), atol=1e-9)
