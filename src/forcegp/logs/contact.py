"""Detection of closed contacts from the distance to the surface, a measured force, or λ and the motion.

The reading of a force-torque sensor is converted to the force and moment that the environment exerts at the
contact, in world coordinates. The sensor has position p_S and rotation R in the world. Its reading f, m is
the action of the environment and gravity on the robot. The weight m_T g of the tool, which acts at its centre
of mass p_T, is subtracted, and the moment is taken about the contact point p_C:

    F = R f − m_T g,   M = R m − (p_T − p_S) × m_T g − (p_C − p_S) × F.

The inertial force m_T p̈_T is neglected, since it is small for lightweight tools and slow motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.errors import DataError
from forcegp.logs.closed import TOUCHING, closed_by_force, hysteresis, merge_short, touching
from forcegp.logs.mapping import GROUND, ContactStateSection, Mapping
from forcegp.logs.table import Array, ImportReport, Signals
from forcegp.robot import RobotModel
from forcegp.robust import level_and_spread, level_of

CHUNK = 1 << 12
"""Number of rows processed at a time."""


def _rowwise(signals: Signals, names: Sequence[str], function: Callable[..., torch.Tensor]) -> Array:
    """Evaluate a function of the named vectors of a log in blocks of rows."""
    blocks = []
    for start in range(0, len(signals), CHUNK):
        rows = slice(start, start + CHUNK)
        vectors = (torch.from_numpy(np.ascontiguousarray(signals.vectors[name][rows])) for name in names)
        blocks.append(function(*vectors).numpy())
    return np.concatenate(blocks)


def _tip(system: ConstrainedSystem, contact: SurfaceContact, q: torch.Tensor) -> torch.Tensor:
    return kinematics.point_position(system.robot, q, contact.frame, tuple(contact.point))


def _wrench(
    robot: RobotModel, mapping: Mapping, q: torch.Tensor, reading: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return, in the world, the force and moment without the tool's weight, and the sensor position."""
    section = mapping.sections.wrench
    assert section is not None
    if section.frame == GROUND:
        rotation = torch.from_numpy(Rotation.from_euler("xyz", section.rpy).as_matrix())
        position = torch.tensor(section.position, dtype=q.dtype).expand(len(q), 3)
    elif section.frame in robot.frame_names:
        rotation, position = kinematics.frame_pose(robot, q, section.frame)
    else:
        listing = ", ".join((*robot.frame_names, GROUND))
        raise mapping.error(("wrench", "frame"), "no such frame of the robot", listing, repr(section.frame))
    sign = 1.0 if section.acts_on == "robot" else -1.0
    force, moment = sign * reading[:, :3], sign * reading[:, 3:]
    if section.axes == "frame":
        force, moment = ((rotation @ x[..., None])[..., 0] for x in (force, moment))
    weight = section.tool_mass * robot.gravity
    arm = rotation @ torch.tensor(section.tool_com, dtype=q.dtype)
    return force - weight, moment - torch.linalg.cross(arm, weight.expand_as(arm)), position


def per_contact(signals: Signals, system: ConstrainedSystem, mapping: Mapping) -> dict[str, dict[str, Array]]:
    """Return `F_sensor` and `M_sensor` at each surface contact, or the `multiplier` from a load cell."""
    touching = [contact for contact in system.contacts if isinstance(contact, SurfaceContact)]
    section = mapping.sections.wrench
    if section is not None and len(section.force) == 1:
        return {"multiplier": {c.name: _evidence(signals, system, mapping, c, "wrench") for c in touching}}

    def sensed(q: torch.Tensor, reading: torch.Tensor) -> torch.Tensor:
        F, moment, sensor = _wrench(system.robot, mapping, q, reading)
        arms = [_tip(system, contact, q) - sensor for contact in touching]
        return torch.stack([F, *(moment - torch.linalg.cross(arm, F) for arm in arms)], dim=1)

    values = _rowwise(signals, ("q", "wrench"), sensed)
    names = [contact.name for contact in touching]
    moments = {name: values[:, 1 + i] for i, name in enumerate(names)}
    return {"F_sensor": dict.fromkeys(names, values[:, 0]), "M_sensor": moments}


def multipliers(signals: Signals, system: ConstrainedSystem, without: Sequence[str] = ()) -> dict[str, Array]:
    """Return λ [N], c [m] and ċ [m/s] `(n, 3)` of each contact with a surface, apart from those in `without`.

    λ = (A M⁻¹Aᵀ)⁺ A (q̈ − M⁻¹Q) holds with all contacts closed at once, and is close to zero for open ones.
    With A of a single contact, forces of the other feet of a robot would count as forces of this one.
    """
    closed = ConstrainedSystem(system.robot, [c for c in system.contacts if c.name not in without])

    def value(q: torch.Tensor, qd: torch.Tensor, qdd: torch.Tensor, tau: torch.Tensor) -> torch.Tensor:
        eom = closed.equations(q, qd)
        rest = qdd - eom.free_acceleration(eom.Q_K + tau)
        return torch.stack([(eom.constraint_inertia @ (eom.A @ rest[..., None]))[..., 0], eom.c, eom.cd], 1)

    values = _rowwise(signals, ("q", "qd", "qdd", "tau"), value)
    touching = [c.name for c in closed.contacts if isinstance(c, SurfaceContact)]
    return {name: values[:, :, closed.rows[name].start] for name in touching}


def _evidence(
    signals: Signals, system: ConstrainedSystem, mapping: Mapping, contact: SurfaceContact, source: str
) -> Array:
    """Return the signal (n,) for detecting a contact: c(q) [m], or the measured n·F [N]."""

    def normal_force(q: torch.Tensor, reading: torch.Tensor) -> torch.Tensor:
        force = _wrench(system.robot, mapping, q, reading)[0]
        return (contact.surface.gradient(_tip(system, contact, q)) * force).sum(1)

    if source == "distance":
        return _rowwise(signals, ("q",), lambda q: contact.center_surface.value(_tip(system, contact, q)))
    return _rowwise(signals, ("q", "wrench"), normal_force)


TOUCHED, LEVEL, INSIDE = 0.02, 0.2, 0.95
"""Fraction of rows on the surface above which the surface is where the scene states. Fractions of moving rows
at a common distance, and of rows inside the solid, above which the surface is elsewhere."""
SLIDING, TRIED_ROWS = 0.01, 500
"""Speed above which a tip counts as moving [m/s]; maximum number of rows on which joint swaps are tried."""
ELSEWHERE = (
    "see where it slides with --fit-surface plane (or sphere), and correct the scene (a wrong tool length or "
    "encoder zero displaces the tip, too); "
    'for free motion, set source = "never" under [contact.{}]'
)


@dataclass(frozen=True)
class Evidence:
    """Evidence for the state of a contact, in N or m. The contact is closed above `threshold`, and intervals
    are extended to `release` on either side. Levels and spreads are NaN for a state that does not occur.
    Closed intervals are given by first and last times [s]. `merged` counts intervals that were too short.
    """

    contact: str
    source: str
    threshold: float
    release: float
    closed_level: float
    closed_spread: float
    open_level: float
    open_spread: float
    intervals: tuple[tuple[float, float], ...]
    merged: int

    def sentence(self) -> str:
        """Return the evidence as one sentence."""
        unit, scale = ("mm", 1e3) if self.source == "distance" else ("N", 1.0)
        listing = ""
        for state in ("closed", "open"):
            level, spread = (scale * getattr(self, f"{state}_{name}") for name in ("level", "spread"))
            listing += f", {level:.3g} ± {spread:.2g} {unit} {state}" if np.isfinite(level) else ""
        return (
            f"contact {self.contact!r} by {self.source}: {len(self.intervals)} closed intervals{listing}, "
            f"threshold {scale * self.threshold:.3g} {unit}"
        )


def detect(
    signals: Signals,
    system: ConstrainedSystem,
    mapping: Mapping,
    report: ImportReport,
    displaced: bool = False,
) -> list[Evidence]:
    """Set `signals.contact` for every contact in the scene, and return the evidence for detected contacts.

    Detection by λ requires `qd` and `qdd`. A tip that slides at a distance from its surface is an error
    unless `displaced` is set.
    """
    sections = mapping.sections.contact
    for name in sections:
        if name not in system.contact_names:
            listing = ", ".join(system.contact_names) or "no contacts"
            raise mapping.error(("contact", name), f"the scene has no contact {name!r}", listing)
    evidence, states, forces = [], {}, {}
    if any(section.source == "multiplier" for section in sections.values()):
        never = [name for name, section in sections.items() if section.source == "never"]
        forces = multipliers(signals, system, never)
    for contact in system.contacts:
        name = contact.name
        if name not in sections:
            text = f"no source determines whether contact {name!r} is closed"
            sources = "column, wrench, multiplier, distance, always or never"
            raise mapping.error(("contact",), text, f"[contact.{name}] with source = {sources}")
        source = sections[name].source
        if source in ("always", "never"):
            states[name] = np.full(len(signals), source == "always")
        elif source == "column":
            states[name] = signals.contact[name]
        elif not isinstance(contact, SurfaceContact):
            text = "only a contact with a surface can be detected"
            raise mapping.error(("contact", name, "source"), text, "column, always or never")
        else:
            moves = None
            if source == "multiplier":
                values, moves = forces[name][:, 0], forces[name][:, 1:]
            else:
                values = _evidence(signals, system, mapping, contact, source)
            touches = np.abs(values) <= (sections[name].threshold or TOUCHING)
            if source == "distance" and len(values) > 1 and touches.mean() <= TOUCHED:
                shift, text = _misplaced(signals, system, contact, values, displaced)
                values = values - shift
                report.find("contact", text)
            states[name], detection = _detect(signals, values, name, sections[name], moves)
            evidence.append(detection)
            report.find("contact", detection.sentence(), signals.row[states[name]])
            if detection.merged:
                report.find("short contact", f"{detection.merged} intervals of {name!r} were too short")
    signals.contact = states
    return evidence


def _misplaced(
    signals: Signals, system: ConstrainedSystem, contact: SurfaceContact, c: Array, displaced: bool
) -> tuple[float, str]:
    """Return the distance [m] at which the tip slides, and a remark; raise unless `displaced` is set."""
    p, name = _rowwise(signals, ("q",), lambda q: _tip(system, contact, q)), contact.name
    moves = np.linalg.norm(np.gradient(p, axis=0), axis=1) > SLIDING * np.median(np.diff(signals.t))
    level, (middle, spread) = level_of(c[moves], TOUCHING, LEVEL), level_and_spread(1e3 * c)
    where = f"{middle:.3g} ± {spread:.2g} mm"
    if level is not None and displaced:
        return level, f"contact {name!r} was taken where the tip slides, {1e3 * level:.3g} mm off"
    pair = exchanged_joints(system, contact, signals.vectors["q"][moves])
    exchanged = " and ".join(signals.joint_names[j] for j in pair)
    if exchanged or level is not None or (c < -TOUCHING).mean() > INSIDE:
        raise DataError(
            f"the tip is {where} from the surface of contact {name!r} (below 0: inside the solid)"
            + (f", and on it with the columns of {exchanged} exchanged" if exchanged else ""),
            expected=f"rows within {1e3 * TOUCHING:g} mm",
            got="none" if level is None else f"sliding at {1e3 * level:.3g} mm",
            hint="match columns to joints by name in the mapping" if exchanged else ELSEWHERE.format(name),
        )
    nearest = 1e3 * float(np.abs(c).min())
    return 0.0, f"contact {name!r} is closed in hardly any row: {where}, {nearest:.3g} at least"


def exchanged_joints(system: ConstrainedSystem, contact: SurfaceContact, q: Array) -> tuple[int, ...]:
    """Return the two joints, if any, that must be swapped to move the tip onto its surface in enough rows."""
    q = q[:: max(1, len(q) // TRIED_ROWS)]
    for pair in combinations(range(q.shape[1]) if len(q) else (), 2):
        order = np.arange(q.shape[1])
        order[list(pair)] = pair[::-1]
        c = contact.center_surface.value(_tip(system, contact, torch.from_numpy(q[:, order])))
        if float((c.abs() <= TOUCHING).double().mean()) > LEVEL:
            return pair
    return ()


def _detect(
    signals: Signals, values: Array, name: str, section: ContactStateSection, moves: Array | None
) -> tuple[NDArray[np.bool_], Evidence]:
    source = section.source
    if source == "distance":
        high = section.threshold or touching(values)
        low, below = section.release or high, section.threshold or TOUCHING
        closed = hysteresis(-values, -high, -low, signals.segment) & (values >= -below)
    else:
        closed, high, low, source = closed_by_force(signals, values, name, section, moves)
    merged = merge_short(closed, signals, section.shortest)
    level = {state: level_and_spread(values[closed == state]) for state in (True, False)}
    spans = [rows for rows in signals.runs(closed) if closed[rows.start]]
    times = tuple((float(signals.t[s.start]), float(signals.t[s.stop - 1])) for s in spans)
    return closed, Evidence(name, source, high, low, *level[True], *level[False], times, merged)
