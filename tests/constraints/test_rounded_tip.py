"""A ball that slides and rolls on a surface: its touching point, lever arm and reach, and MuJoCo's forces."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

import forcegp
from constraints.cases import CONSTRAINTS, chain, random_state, system_of
from forcegp.constraints import ConstrainedSystem, Cylinder, ImplicitSurface, Plane, Sphere, SurfaceContact
from forcegp.constraints.unilateral import sliding_friction
from forcegp.errors import ParameterError

STEP = 1e-6
"""Step of central differences [s]: h² times third derivatives and rounding of 1e-15 / h are below 1e-8."""
PENETRATION = 1e-7
"""How deep MuJoCo's ball is in its floor [m]; MuJoCo's contact point is half of it off the surface."""


@pytest.mark.parametrize("kind", ["rounded", "balls"])
def test_the_touching_point_is_a_material_point_of_the_ball(kind: str) -> None:
    system = system_of(kind, seed=1)
    (contact,) = system.contacts
    assert isinstance(contact, SurfaceContact)
    q, qd, _ = random_state(system, 5)
    at = system.equations(q, qd)
    point = at.contact_points[contact.name]
    center = forcegp.kinematics.point_position(system.robot, q, "tool", contact.point)
    distance = (point.position - center).norm(dim=-1)
    torch.testing.assert_close(distance, torch.full_like(distance, contact.radius))
    n = normalize(contact.surface.gradient(center), dim=-1)
    torch.testing.assert_close(contact.surface.value(center - contact.radius * n), at.c[:, 0])
    # Held fast in the link, the point moves with the velocity that friction acts against.
    R, p = forcegp.kinematics.frame_pose(system.robot, q, "tool")
    own = (R.mT @ (point.position - p)[..., None])[..., 0]

    def moved(t: float) -> torch.Tensor:
        R, p = forcegp.kinematics.frame_pose(system.robot, q + t * qd, "tool")
        return p + (R @ own[..., None])[..., 0]

    velocity = (moved(STEP) - moved(-STEP)) / (2 * STEP)
    torch.testing.assert_close(point.velocity, velocity, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close((point.jacobian @ qd[..., None])[..., 0], point.velocity)
    torch.testing.assert_close(point.normal[..., None, :] @ point.jacobian, at.A)


@pytest.mark.parametrize("kind", ["rounded", "balls"])
def test_friction_at_a_rounded_tip_takes_energy(kind: str) -> None:
    system = system_of(kind, seed=2)
    q, qd, _ = random_state(system, 20)
    Q_z = sliding_friction(system, system.equations(q, qd), torch.ones(20, 1, dtype=torch.bool), 1.0)
    assert bool(((Q_z * qd).sum(-1) < 0.0).all())


def test_a_ball_that_rolls_has_no_friction(bar: ConstrainedSystem) -> None:
    """A ball on a bar with two slides and a hinge, turning as fast as it advances."""
    q = torch.tensor([0.3, 0.1, 0.0], dtype=torch.float64)
    qd = torch.tensor([0.1 * 2.0, 0.0, 2.0], dtype=torch.float64)
    at = bar.equations(q, qd)
    assert float(at.contact_points["floor"].velocity.abs().max()) < 1e-15
    rolling = sliding_friction(bar, at, torch.ones(1, dtype=torch.bool), 1.0)
    assert float(rolling.abs().max()) < 1e-15


def test_mujoco_presses_and_rubs_with_the_same_generalized_forces(bar: ConstrainedSystem) -> None:
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(BAR.replace("</worldbody>", FLOOR + "</worldbody>"))
    model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    data = mujoco.MjData(model)
    data.qpos[:] = [0.3, 0.1 - PENETRATION, 0.7]
    data.qvel[:] = [0.4, 0.0, 1.1]
    data.qfrc_applied[:] = [1.0, -20.0, 0.5]
    mujoco.mj_forward(model, data)
    assert data.ncon == 1
    force = np.zeros(6)
    mujoco.mj_contactForce(model, data, 0, force)
    on_floor = data.contact[0].frame.reshape(3, 3).T @ force[:3]
    on_tip = on_floor if on_floor[2] > 0.0 else -on_floor
    assert on_tip[2] > 1.0 and abs(on_tip[0]) > 0.1
    at = bar.equations(torch.tensor(data.qpos), torch.tensor(data.qvel))
    J = at.contact_points["floor"].jacobian.numpy()
    found = at.A.numpy().T[:, 0] * on_tip[2] + J.T @ (on_tip * [1.0, 1.0, 0.0])
    np.testing.assert_allclose(found, data.qfrc_constraint, atol=PENETRATION * np.abs(on_tip).max())


def test_a_surface_is_raised_along_its_normal() -> None:
    p = torch.randn(10, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for surface in (
        Plane((0.2, 0.3, 1.0), 0.1),
        Sphere((3, 1, 0.5), 0.5),
        Cylinder((3, 1, 0), (1, 2, 0), 0.2),
    ):
        torch.testing.assert_close(surface.raised(0.07).value(p), surface.value(p) - 0.07)


def test_what_cannot_be_a_ball_is_refused() -> None:
    (contact,) = CONSTRAINTS["rounded"]
    with pytest.raises(ParameterError, match="the tip of contact 'round' has an invalid radius"):
        dataclasses.replace(contact, radius=-0.1)
    with pytest.raises(ParameterError, match="ImplicitSurface cannot be offset"):
        SurfaceContact("hill", "tool", (0.0, 0.0, 0.1), ImplicitSurface(lambda p: p[2]), radius=0.1)
    SurfaceContact("hill", "tool", (0.0, 0.0, 0.1), ImplicitSurface(lambda p: p[2])).check(chain(0))


BAR = """<mujoco><worldbody>
<body name="cart"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
<joint name="x" type="slide" axis="1 0 0"/>
<body name="lift"><inertial pos="0 0 0" mass="0.5" diaginertia="1 1 1"/>
<joint name="z" type="slide" axis="0 0 1"/>
<body name="ball"><joint name="turn" type="hinge" axis="0 1 0"/>
<inertial pos="0.1 0 0.2" mass="2" diaginertia="0.02 0.02 0.02"/>
<geom name="tip" type="sphere" size="0.1" mass="0" friction="0.5 0 0" condim="3"/></body></body></body>
</worldbody></mujoco>"""
FLOOR = '<geom name="floor" type="plane" size="0 0 1" friction="0.5 0 0" condim="3"/>'


@pytest.fixture
def bar(tmp_path: Path) -> ConstrainedSystem:
    """A ball on a bar over a floor."""
    path = tmp_path / "bar.xml"
    path.write_text(BAR)
    tip = SurfaceContact("floor", "ball", (0.0, 0.0, 0.0), Plane(), radius=0.1)
    return ConstrainedSystem(forcegp.load_robot(path, gravity=(0, 0, -9.81)), [tip])
