"""Wrench sensors: frame, sign, the tool's weight, and the way to the contact."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import forcegp
from forcegp.errors import MappingError
from forcegp.logs import parse_mapping
from forcegp.logs.contact import per_contact
from forcegp.logs.mapping import WrenchSection
from forcegp.logs.signals import Signals

FRAME = "lbr_iiwa_link_7"


@pytest.fixture
def system() -> forcegp.ConstrainedSystem:
    robot = forcegp.load_robot("kuka_iiwa")
    table = forcegp.SurfaceContact("table", FRAME, (0.02, -0.01, 0.15), forcegp.Plane())
    return forcegp.ConstrainedSystem(robot, [table])


def reading(
    system: forcegp.ConstrainedSystem, q: torch.Tensor, force: np.ndarray, section: WrenchSection
) -> np.ndarray:
    """What a sensor shows under a force at the contact point and the tool's weight."""
    rows = []
    for row, f in zip(q, force, strict=True):
        R, p = (x.numpy() for x in forcegp.kinematics.frame_pose(system.robot, row, FRAME))
        tip = p + R @ np.array([0.02, -0.01, 0.15])
        com = p + R @ np.array(section.tool_com)
        weight = section.tool_mass * np.array([0.0, 0.0, -9.81])
        F, M = f + weight, np.cross(tip - p, f) + np.cross(com - p, weight)
        if section.axes == "frame":
            F, M = R.T @ F, R.T @ M
        rows.append(np.concatenate([F, M]) * (1.0 if section.acts_on == "robot" else -1.0))
    return np.array(rows)


@pytest.mark.parametrize("axes", ["frame", "world"])
@pytest.mark.parametrize("acts_on", ["robot", "environment"])
def test_the_force_at_the_contact_is_recovered(
    system: forcegp.ConstrainedSystem, axes: str, acts_on: str
) -> None:
    toml = (
        '[time]\ncolumn = "t"\n[position]\ncolumn = "q{joint}"\nunit = "rad"\n'
        '[torque]\ncolumn = "i{joint}"\nunit = "Nm"\n'
        f'[wrench]\nforce = ["x", "y", "z"]\nframe = "{FRAME}"\naxes = "{axes}"\n'
        f'acts_on = "{acts_on}"\ntool_mass = 1.5\ntool_com = [0.01, 0.02, 0.08]\n'
    )
    mapping = parse_mapping(toml.encode(), "m.toml")
    section = mapping.sections.wrench
    assert section is not None
    random = torch.Generator().manual_seed(0)
    q = torch.randn(20, 7, dtype=torch.float64, generator=random)
    force = torch.randn(20, 3, dtype=torch.float64, generator=random).numpy() * 20.0
    vectors = {"q": q.numpy(), "wrench": reading(system, q, force, section)}
    signals = Signals(
        system.robot.joint_names, np.arange(20.0), np.arange(20), np.zeros(20, np.int64), vectors
    )
    found = per_contact(signals, system, mapping)
    # Rounding of forces of 60 N and moments of 10 N m.
    np.testing.assert_allclose(found["F_sensor"]["table"], force, atol=1e-12)
    np.testing.assert_allclose(found["M_sensor"]["table"], np.zeros((20, 3)), atol=1e-12)
    other = parse_mapping(toml.replace(FRAME, "hand").encode(), "m.toml")
    with pytest.raises(MappingError, match=r"m.toml:\d+: wrench.frame: no such frame"):
        per_contact(signals, system, other)
