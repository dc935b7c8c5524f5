"""Check whether the joint angles place the tip on the surface in rows labelled as contact.

If the surface is displaced, the distance between tip and surface is a linear function of the tip position. If
the angles are wrong, a single correction moves the tip onto the surface in all rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from forcegp.checks import hypotheses
from forcegp.checks.contact import FAR, OFFSET, SLIDING_SLOW, Path, fit_surface, tip_path, touching
from forcegp.checks.finding import Finding, at_rows
from forcegp.checks.fit import cross_validate, labelled_contacts
from forcegp.checks.hypotheses import Hypothesis, corrected, discrete, unchanged
from forcegp.checks.log import Log, Outcome, displacement, evenly
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.logs.closed import TOUCHING
from forcegp.logs.contact import LEVEL, TRIED_ROWS, exchanged_joints
from forcegp.robot.model import RobotModel
from forcegp.robust import level_of, robust_std

ROWS = 2000
"""Maximum number of contact rows used."""
BETTER = 0.25
"""Largest accepted residual with corrected angles, relative to the residual with a displaced surface."""
Correction = tuple[Hypothesis, Log]


def check_placement(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find joints with a wrong sign, order or offset, based on the position of the tip in contact."""
    for contact, rows in touching(system, log):
        path = tip_path(system, contact, log, rows)
        if abs(np.median(path.c)) <= FAR:
            continue
        scatter = robust_std(path.c - fit_surface(contact, path, np.ones(len(rows), bool))[2])
        rows = evenly(rows, ROWS)
        most = min(OFFSET, BETTER * float(scatter))
        if (outcome := _explanation(system, contact, log, rows, most)) is not None:
            return outcome
    for contact in labelled_contacts(system, log):
        # If the tip is displaced, no row is labelled as contact by distance.
        if not isinstance(contact, SurfaceContact) or log.contact[contact.name].any():
            continue
        path = tip_path(system, contact, log)
        if on := _on_surface(contact, log, path):
            closed = np.isfinite(path.c) & (np.abs(path.c) <= TOUCHING)
            return [on], log.replace(contact={**log.contact, contact.name: closed})
        moves = log.usable & (np.linalg.norm(path.v, axis=1) > SLIDING_SLOW)
        c = path.c[moves]
        if (np.abs(c) <= TOUCHING).sum() > LEVEL * len(c):
            continue
        if pair := exchanged_joints(system, contact, log.q[moves]):
            both, where = tuple(log.joint_names[j] for j in pair), f"{1e3 * np.median(c):+.3g}"
            where = f"{where} ± {1e3 * robust_std(c):.2g} mm from the surface of {contact.name!r}"
            text = f"the tip is {where}, and on it if {' and '.join(both)} are exchanged"
            finding = log.finding("joint-order", text, both)
            return [finding], log.changed(("q", "qd", "qdd", "tau"), order=pair)
        if len(c) and level_of(c, TOUCHING, LEVEL) is None:
            rows = evenly(np.flatnonzero(moves), TRIED_ROWS)
            if (outcome := _never_closed(system, contact, log, rows)) is not None:
                return outcome
    return [], log


def _on_surface(contact: SurfaceContact, log: Log, path: Path) -> Finding | None:
    """Return the finding that a tip stays on the surface in many rows although the contact never closes."""
    level = level_of(path.c[log.usable], TOUCHING, LEVEL)
    if level is None or abs(level) > TOUCHING:
        return None
    rows = log.usable & (np.abs(path.c - level) <= TOUCHING)
    text = f"contact {contact.name!r} is never closed, but the tip lies on its surface in "
    text += f"{100 * rows.sum() / log.usable.sum():.0f} % of the rows:"
    finding = at_rows(rows, "contact-missed", text, rows=rows.sum())[0]
    return replace(finding, contact=contact.name, weight="error")


def _never_closed(
    system: ConstrainedSystem, contact: SurfaceContact, log: Log, rows: np.ndarray
) -> Outcome | None:
    """Return the single correction that brings a tip that is never in contact to the surface, if any."""
    signs = ((h, h.change(log)) for h in discrete(system, log) if h.name == "joint-sign")
    tried = []
    for h, other in (*signs, *_offsets(system, contact, log, rows, LEVEL)):
        share = float((np.abs(tip_path(system, contact, other, rows).c) <= TOUCHING).mean())
        tried += [(share, h, other)] if share > LEVEL else []
    if not tried:
        return None
    most, near = max(share for share, _, _ in tried), []
    for h, other in ((h, other) for share, h, other in tried if share == most):
        closed = np.abs(tip_path(system, contact, other).c) <= TOUCHING
        near.append((h, other.replace(contact={**log.contact, contact.name: closed})))
    motion = f"{100 * most:.0f} % of the motion"
    where = f"{contact.name!r} is never closed, but the tip touches it in {motion} if"
    return _chosen(system, contact, log, near, where)


def _chosen(
    system: ConstrainedSystem, contact: SurfaceContact, log: Log, near: list[Correction], where: str
) -> Outcome:
    """Return a finding on equally good corrections, and the log after the one that fits the torques best."""
    rows = evenly(np.flatnonzero(log.usable), TRIED_ROWS)
    scores = [cross_validate(hypotheses.problem_of(system, other, rows)).score.mean() for _, other in near]
    best, repaired = near[int(np.argmin(scores))]
    alike = [h for h, _ in near if h.name == best.name]
    return [_finding(system.robot, log, contact, alike, where)], repaired


def leaves_surface(system: ConstrainedSystem, before: Log, after: Log) -> bool:
    """Return whether a correction moves the tip away from the surface in rows labelled as contact."""
    if after.q is before.q:
        return False
    for contact, rows in touching(system, before):
        rows = rows[:: max(1, len(rows) // ROWS)]
        if _off(system, contact, before, rows) <= FAR < _off(system, contact, after, rows):
            return True
    return False


def _explanation(
    system: ConstrainedSystem, contact: SurfaceContact, log: Log, rows: np.ndarray, most: float
) -> Outcome | None:
    """Return the correction of the angles that places the tip on the surface, if any."""
    angles = ((h, h.change(log)) for h in discrete(system, log) if h.name in ("joint-sign", "joint-order"))
    for candidates in (angles, _offsets(system, contact, log, rows)):
        near = [(h, other) for h, other in candidates if _off(system, contact, other, rows) <= most]
        if near:
            where = f"the tip touches {contact.name!r} in rows labelled as contact if"
            return _chosen(system, contact, log, near, where)
    return None


def _off(system: ConstrainedSystem, contact: SurfaceContact, log: Log, rows: np.ndarray) -> float:
    """Return the median distance between tip and surface [m]."""
    return float(np.median(np.abs(tip_path(system, contact, log, rows).c)))


def _offsets(
    system: ConstrainedSystem, contact: SurfaceContact, log: Log, rows: np.ndarray, share: float | None = None
) -> Iterator[Correction]:
    """Yield, for each encoder, the offset that moves the tip to the surface, from Gauss-Newton steps.

    If `share` is given, one offset is computed per row, and the offset common to this fraction is used.
    """
    few = log.replace(q=log.q[rows], qd=log.qd[rows])
    for j in range(log.nq):
        hypothesis, offset = Hypothesis("encoder-offset", 1, unchanged, joints=(j,)), np.zeros(len(rows))
        for _ in range(6):
            moved = (few.q + np.outer(offset + step, np.eye(log.nq)[j]) for step in (0.0, 1e-5))
            c, ahead = (tip_path(system, contact, few.replace(q=q), np.arange(len(q))).c for q in moved)
            slope = (ahead - c) / 1e-5
            ascent = np.stack([slope * c, slope**2])
            total = ascent if share is not None else ascent.sum(axis=1, keepdims=True)
            offset = offset - total[0] / np.maximum(total[1], 1e-12)
        if share is not None:
            offset = np.array([level_of(offset, hypotheses.SMALL_ANGLE, share) or 0.0])
        if abs(offset[0]) <= hypotheses.LARGEST_ANGLE:
            yield replace(hypothesis, columns=offset[:1]), corrected(log, hypothesis, offset[:1])


def _finding(
    robot: RobotModel, log: Log, contact: SurfaceContact, alike: list[Hypothesis], touches: str
) -> Finding:
    names = tuple(dict.fromkeys(log.joint_names[j] for h in alike for j in h.joints))
    listed = (" and " if alike[0].name == "joint-order" and len(alike) == 1 else " or ").join(names)
    if alike[0].name == "encoder-offset":
        offset = float(alike[0].columns[0])  # type: ignore[index]
        added = displacement(robot, alike[0].joints[0], offset)
        text = f"{touches} {added} are added to the position of {listed}"
        return Finding("encoder-offset", text, log.all_rows, names, contact.name, {"add_rad": offset})
    change = {"joint-sign": "turns the other way", "joint-order": "are exchanged"}[alike[0].name]
    return Finding(alike[0].name, f"{touches} {listed} {change}", log.all_rows, names, contact.name)
