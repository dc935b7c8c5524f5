"""A simulated log as another program would write it: CSV in degrees and milliseconds, no accelerations.

The imported log is compared with the simulation that it came from.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem, Plane, SurfaceContact
from forcegp.data import Dataset, complement, split_by_stretches, without_marked_impacts
from forcegp.errors import DataError
from forcegp.files import write_text
from forcegp.logs.surface_fit import fit_surface

START = 1_700_000_000_000
"""First time stamp [ms]."""
DIGITS = 6
"""Decimals of each value: 10⁻⁶ degrees."""
MATCHED = 1e-6
"""Rounding of the exported positions [rad]."""


def write_foreign_log(
    path: Path, data: Dataset, system: ConstrainedSystem, *, force_noise: float = 0.3, seed: int = 0
) -> None:
    """Write time, positions, velocities, torques, and what a sensor at the wrist would measure.

    Args:
        path: the CSV file, separated by semicolons.
        data: simulated with MuJoCo's contact solver, so that it holds contact forces.
        system: its robot, with one contact.
        force_noise: standard deviation of the noise of the sensor's force [N].
        seed: of that noise.

    Raises:
        DataError: the log does not hold the forces of a single contact with a surface.
    """
    if len(system.contacts) != 1 or "F_z" not in data.contact_extras:
        raise DataError("the log does not hold the force of a single contact", hint='contact = "solver"')
    (contact,) = system.contacts
    assert isinstance(contact, SurfaceContact)
    force = data.contact_extras["F_I"][contact.name] + data.contact_extras["F_z"][contact.name]
    rotation, _ = kinematics.frame_pose(system.robot, data.q, contact.frame)
    noise = torch.randn(force.shape, generator=torch.Generator().manual_seed(seed), dtype=force.dtype)
    sensed = (rotation.mT @ force[..., None])[..., 0] + force_noise * noise
    names = data.joint_names
    headings = ["time [ms]", *(f"pos {n} [deg]" for n in names), *(f"vel {n} [deg/s]" for n in names)]
    headings += [*(f"torque {n} [Nm]" for n in names), *(f"force_{axis}" for axis in "xyz")]
    degrees = np.degrees(torch.cat([data.q, data.qd], -1).numpy())
    table = np.column_stack([START + 1e3 * data.t.numpy(), degrees, data.tau.numpy(), sensed.numpy()])
    lines = [";".join(headings), *(";".join(map(repr, row)) for row in np.round(table, DIGITS).tolist())]
    write_text(path, "\n".join(lines) + "\n")


def mapping_of(system: ConstrainedSystem, source: str = "multiplier") -> str:
    """The mapping of such a log.

    Args:
        system: its robot, with one contact.
        source: what the state of the contact is read from: `multiplier`, `wrench` or `distance`.
    """
    (contact,) = system.contacts
    assert isinstance(contact, SurfaceContact)
    return f"""[time]
column = "time [ms]"
unit = "ms"

[position]
column = "pos {{joint}} [deg]"
unit = "deg"

[velocity]
column = "vel {{joint}} [deg/s]"
unit = "deg/s"

[torque]
column = "torque {{joint}} [Nm]"
unit = "Nm"

[wrench]
force = ["force_x", "force_y", "force_z"]
frame = "{contact.frame}"
axes = "frame"
acts_on = "robot"

[contact.{contact.name}]
source = "{source}"
"""


def rows_right(log: Dataset, truth: Dataset, system: ConstrainedSystem) -> float:
    """Share of the imported rows whose contact is the simulator's."""
    name, rows = system.contact_names[0], rows_of(log, truth)
    return float((log.contact[name] == truth.contact[name][rows]).double().mean())


def rows_of(log: Dataset, truth: Dataset) -> torch.Tensor:
    """The simulated row of each imported one.

    Raises:
        DataError: the positions are not those of the simulation.
    """
    first = int((truth.q - log.q[0]).abs().amax(-1).argmin())
    since = (log.t - log.t[0]) / truth.t.diff().median()
    rows = first + since.round().long()
    if int(rows[-1]) >= len(truth) or float((truth.q[rows] - log.q).abs().max()) > MATCHED:
        raise DataError("the imported rows are not those of the simulation")
    return rows


def surface_error(log: Dataset, system: ConstrainedSystem) -> dict[str, float]:
    """How far the surface fitted to the tip's path is from the scene's, along the path [mm] and [degrees]."""
    (contact,) = system.contacts
    assert isinstance(contact, SurfaceContact)
    fit = fit_surface(log, system, contact.name, "plane" if isinstance(contact.surface, Plane) else "sphere")
    q = log.q[log.contact[contact.name]]
    point = kinematics.point_position(system.robot, q, contact.frame, tuple(contact.point))
    normal = contact.surface.gradient(point)
    touching = point - contact.center_surface.value(point)[:, None] * normal - contact.radius * normal
    turned = torch.linalg.cross(fit.surface.gradient(touching), normal).norm(dim=-1)
    return {
        "offset_mm": 1e3 * float(fit.surface.value(touching).abs().mean()),
        "tilt_degrees": float(np.degrees(turned.max())),
    }


def selected(log: Dataset, truth: Dataset, system: ConstrainedSystem) -> tuple[Dataset, Dataset]:
    """The log but for held-out stretches, and these with the simulator's normal force.

    Rows at impacts are left out, as by `forcegp select`: no smooth acceleration describes them.
    """
    log = without_marked_impacts(log)
    split = split_by_stretches(log, 1)
    name, rows = system.contact_names[0], rows_of(log, truth)
    force = {name: truth.contact_extras["multiplier"][name][rows]}
    known = log.replace(contact_extras={**log.contact_extras, "multiplier": force})
    return log[complement(split.test, len(log))], known[split.test]
