"""Do the joint angles place the tip on the surface where the log says that it touches?

A tip that is centimetres off the surface has one of two causes. Either the surface lies elsewhere: then the
distance is a plane over the path. Or the angles are wrong: then one change of them takes the tip onto the
surface in all rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import combinations

import numpy as np
import torch

from forcegp import kinematics
from forcegp.checks.contact import FAR, LEAST_ROWS, OFFSET, fit_surface, tip_path
from forcegp.checks.finding import Finding
from forcegp.checks.fit import tensors
from forcegp.checks.hypotheses import Hypothesis, flipped, swapped, unchanged
from forcegp.checks.log import Array, Log, Outcome, displacement, evenly
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.data.fields import JOINT_VECTORS
from forcegp.robot.model import RobotModel
from forcegp.robust import robust_std

ROWS = 2000
"""Contact rows that are looked at."""
BETTER = 0.25
"""Share of what a displaced surface leaves that changed angles may leave."""
LARGEST = 1.0
"""Largest encoder offset that is looked for [rad]."""
STEPS = 6


def check_placement(system: ConstrainedSystem, log: Log) -> Outcome:
    """Joints that turn the other way, are exchanged or have an offset, told by the tip in contact."""
    for contact, rows in _touching(system, log):
        path = tip_path(system, contact, log)
        if abs(np.median(path.c[rows])) <= FAR:
            continue
        closed = log.contact[contact.name] & log.usable
        scatter = robust_std((path.c - fit_surface(contact, path, closed)[2])[closed])
        rows = evenly(rows, ROWS)
        outcome = _explanation(system, contact, log, rows, min(OFFSET, BETTER * float(scatter)))
        if outcome is not None:
            return outcome
    return [], log


def _touching(system: ConstrainedSystem, log: Log) -> Iterator[tuple[SurfaceContact, np.ndarray]]:
    """The contacts with surfaces that are labelled as closed in enough rows, and these rows."""
    for contact in system.contacts:
        if isinstance(contact, SurfaceContact) and contact.name in log.contact:
            rows = np.flatnonzero(log.contact[contact.name] & log.usable)
            if len(rows) >= LEAST_ROWS:
                yield contact, rows


def leaves_surface(system: ConstrainedSystem, before: Log, after: Log) -> bool:
    """Whether changed angles take a tip off the surface in rows that are labelled as contact."""
    if after.q is before.q:
        return False
    for contact, rows in _touching(system, before):
        rows = rows[:: max(1, len(rows) // ROWS)]
        if _off(system, contact, before, rows) <= FAR < _off(system, contact, after, rows):
            return True
    return False


def _explanation(
    system: ConstrainedSystem, contact: SurfaceContact, log: Log, rows: np.ndarray, most: float
) -> Outcome | None:
    """The change of angles that leaves the tip on the surface, if there is one."""
    for candidates in (_discrete(log), _offsets(system, contact, log, rows)):
        tried = [(h, changed, _off(system, contact, changed, rows)) for h, changed in candidates]
        near = [(h, changed) for h, changed, off in tried if off <= most]
        if near:
            # Two joints that turn in one plane and their mirror image touch alike.
            alike = [h for h, _ in near if h.name == near[0][0].name]
            return [_finding(system.robot, log, contact, alike)], near[0][1]
    return None


def _off(system: ConstrainedSystem, contact: SurfaceContact, log: Log, rows: np.ndarray) -> float:
    """Median distance of the tip from the surface [m]."""
    return float(np.median(np.abs(_distance(system, contact, log, rows))))


def _distance(system: ConstrainedSystem, contact: SurfaceContact, log: Log, rows: np.ndarray) -> Array:
    (q,) = tensors(log, rows, "q")
    with torch.no_grad():
        p = kinematics.point_position(system.robot, q, contact.frame, contact.point)
        return contact.center_surface.value(p).numpy()


def _discrete(log: Log) -> Iterator[tuple[Hypothesis, Log]]:
    for j in range(log.nq):
        change = partial(flipped, j=j, names=JOINT_VECTORS)
        yield Hypothesis("joint-sign", 0, change, joints=(j,)), change(log)
    for i, j in combinations(range(log.nq), 2):
        change = partial(swapped, i=i, j=j, names=JOINT_VECTORS)
        yield Hypothesis("joint-order", 0, change, joints=(i, j)), change(log)


def _offsets(
    system: ConstrainedSystem, contact: SurfaceContact, log: Log, rows: np.ndarray
) -> Iterator[tuple[Hypothesis, Log]]:
    """Each encoder with the offset that takes the tip to the surface, by Gauss-Newton steps."""
    for j in range(log.nq):
        offset = 0.0
        for _ in range(STEPS):
            c = _distance(system, contact, _moved(log, j, offset), rows)
            slope = (_distance(system, contact, _moved(log, j, offset + 1e-5), rows) - c) / 1e-5
            offset -= float((slope @ c) / max(slope @ slope, 1e-12))
        if abs(offset) <= LARGEST:
            hypothesis = Hypothesis("encoder-offset", 1, unchanged, np.array([offset]), joints=(j,))
            yield hypothesis, _moved(log, j, offset)


def _moved(log: Log, j: int, offset: float) -> Log:
    q = log.q.copy()
    q[:, j] += offset
    return log.replace(q=q)


def _finding(robot: RobotModel, log: Log, contact: SurfaceContact, alike: list[Hypothesis]) -> Finding:
    names = tuple(dict.fromkeys(log.joint_names[j] for h in alike for j in h.joints))
    listed = (" and " if alike[0].name == "joint-order" and len(alike) == 1 else " or ").join(names)
    touches = f"the tip touches {contact.name!r} where the log says so if"
    if alike[0].name == "encoder-offset":
        offset = float(alike[0].columns[0])  # type: ignore[index]
        added = displacement(robot, alike[0].joints[0], offset)
        text = f"{touches} {added} are added to the position of {listed}"
        return Finding("encoder-offset", text, log.all_rows, names, contact.name, {"add_rad": offset})
    change = {"joint-sign": "turns the other way", "joint-order": "are exchanged"}[alike[0].name]
    return Finding(alike[0].name, f"{touches} {listed} {change}", log.all_rows, names, contact.name)
