"""Wrench sensors: frame, sign, the tool's weight, and the way to the contact."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import forcegp
from forcegp.errors import MappingError
from forcegp.logs import parse_mapping, read_log
from forcegp.logs.contact import per_contact
from forcegp.logs.mapping import WrenchSection
from forcegp.logs.table import Signals

FRAME = "lbr_iiwa_link_7"
EXAMPLES = Path(__file__).parents[2] / "examples/data"


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


HEAD = (
    '[time]\ncolumn = "t"\n[position]\ncolumn = "q{joint}"\nunit = "rad"\n'
    '[torque]\ncolumn = "i{joint}"\nunit = "Nm"\n'
)


def test_a_sensor_on_the_ground_gives_the_force_at_the_contact(system: forcegp.ConstrainedSystem) -> None:
    """A plate that is turned by 90° about z and shows the force on itself, as that under a foot does."""
    toml = HEAD + (
        '[wrench]\nforce = ["x", "y", "z"]\ntorque = ["a", "b", "c"]\nframe = "ground"\n'
        f'position = [0.3, 0.1, 0.0]\nrpy = [0.0, 0.0, {np.pi / 2}]\nacts_on = "environment"\n'
    )
    random = np.random.default_rng(0)
    q, force = random.normal(size=(20, 7)), 20.0 * random.normal(size=(20, 3))
    contact = system.contacts[0]
    assert isinstance(contact, forcegp.SurfaceContact)
    tip = forcegp.kinematics.point_position(system.robot, torch.from_numpy(q), FRAME, contact.point).numpy()
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    F, M = force, np.cross(tip - [0.3, 0.1, 0.0], force)
    vectors = {"q": q, "wrench": -np.concatenate([F @ R, M @ R], axis=1)}
    rows = np.arange(20)
    signals = Signals(system.robot.joint_names, 1.0 * rows, rows, np.zeros(20, np.int64), vectors)
    found = per_contact(signals, system, parse_mapping(toml.encode(), "m.toml"))
    np.testing.assert_allclose(found["F_sensor"]["table"], force, atol=1e-12)
    np.testing.assert_allclose(found["M_sensor"]["table"], np.zeros((20, 3)), atol=1e-12)


def test_a_load_cell_gives_the_normal_force(tmp_path: Path) -> None:
    """One column, upside down, in kilonewtons, with an offset: the multiplier of the contact."""
    system = forcegp.load_scene("ur5_wiping").system()
    names = system.robot.joint_names
    toml = (
        '[time]\ncolumn = "timestamp"\n[joints]\n'
        + "".join(f'{joint} = "{i}"\n' for i, joint in enumerate(names))
        + '[position]\ncolumn = "actual_q_{joint}"\nunit = "rad"\n'
        + '[torque]\ncolumn = "actual_torque_{joint}"\nunit = "Nm"\n'
        + '[wrench]\nforce = ["cell"]\nframe = "ground"\nforce_unit = "kN"\naxis = [0.0, 0.0, -1.0]\n'
        + "offset = [0.5, 0.0, 0.0, 0.0, 0.0, 0.0]\n"
        + '[contact.table]\nsource = "wrench"\n'
    )
    lines = (EXAMPLES / "ur5_wiping.csv").read_text().splitlines()[:1500]
    table = [line.split(",") for line in lines[1:]]
    force = np.array([float(row[-1]) for row in table])
    rows = [",".join([*row[:-1], f"{0.5 - 1e-3 * f:.9f}"]) for row, f in zip(table, force, strict=True)]
    (tmp_path / "run.csv").write_text("\n".join([lines[0].replace("table_force", "cell"), *rows]))
    (tmp_path / "mapping.toml").write_text(toml)
    data = read_log(tmp_path / "run.csv", system, tmp_path / "mapping.toml")
    logged = data.contact_extras["multiplier"]["table"].numpy()
    np.testing.assert_allclose(logged, force[-len(logged) :], atol=1e-5)  # a first row alone is dropped
    closed = data.contact["table"].numpy()
    assert closed.any() and ((logged > 1.0) == closed).mean() > 0.99


@pytest.mark.parametrize("wrench", ['force = ["x", "y"]', 'force = ["x"]\ntorque = ["a", "b", "c"]'])
def test_a_force_has_one_column_or_three(wrench: str) -> None:
    with pytest.raises(MappingError, match=r"wrench.force: not a force(?s:.*)one column, or three"):
        parse_mapping(f'{HEAD}[wrench]\n{wrench}\nframe = "ground"\n'.encode(), "m.toml")
