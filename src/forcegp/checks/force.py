"""What force the labelled contacts carry: the surface must push, and friction opposes the sliding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from forcegp.checks.clock import Outcome
from forcegp.checks.contact import LEAST_ROWS, Path, tip_path
from forcegp.checks.finding import Finding
from forcegp.checks.fit import Array, blocks_of
from forcegp.checks.log import Log
from forcegp.checks.residual import residual
from forcegp.checks.statistics import intervals
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.robust import robust_std

ROWS = 4000
"""Contact rows whose force is computed."""
PULLS = 0.5
"""Share of contact rows with a pulling force from which the normal must be the wrong way round."""
SIGNIFICANT = 4.0
"""Standard errors over blocks from which friction is there."""
SLOW = 0.01
"""Speed below which the direction of sliding is unknown [m/s]."""
NARROW = 0.05
"""Share of the sliding motion that the second direction must have."""


def check_forces(system: ConstrainedSystem, log: Log) -> Outcome:
    """Normal force, friction and directions of sliding of each contact, where the arm can tell the force."""
    found = []
    for contact in system.contacts:
        if isinstance(contact, SurfaceContact) and contact.name in log.contact:
            path = tip_path(system, contact, log)
            rows = np.flatnonzero(log.contact[contact.name] & log.usable)
            rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(ROWS, len(rows))).astype(np.int64))]
            if len(rows) >= LEAST_ROWS:
                found += _directions(contact, path, log)
                force = _force(replace(system, contacts=[contact]), log, rows, path)
                pulls = _pulls(contact, path, force, rows, log)
                found += pulls or (_friction(contact, path, force, rows, log) if log.nq > 3 else [])
    return found, log


def _force(system: ConstrainedSystem, log: Log, rows: np.ndarray, path: Path) -> Array:
    """Force `(n, 3)` at the touching point that explains the torque best, r = Jᵀ F.

    With three torques or fewer, which any force would explain, it is the best one along the normal, r = Aᵀ λ.
    """
    left = residual(system, log, rows)
    if log.nq <= 3:
        A = left.J[:, 0]
        size = np.maximum((A * A).sum(axis=1), 1e-12)
        return ((A * left.r).sum(axis=1) / size)[:, None] * path.normal[rows]
    gram = left.J @ left.J.transpose(0, 2, 1)
    return np.linalg.solve(gram + 1e-9 * np.eye(3), (left.J @ left.r[..., None]))[..., 0]


def _pulls(contact: SurfaceContact, path: Path, force: Array, rows: np.ndarray, log: Log) -> list[Finding]:
    normal = (force * path.normal[rows]).sum(axis=1)
    # Away from the mean the scatter is noise and true change alike; an arm that presses stays above it.
    if not (
        np.median(normal) < 0.0 and (normal < 0.0).mean() > PULLS and -np.median(normal) > robust_std(normal)
    ):
        return []
    text = f"the force at {contact.name!r} pulls with {-np.median(normal):.3g} N along the normal"
    spans = intervals(log.contact[contact.name])
    evidence = {"normal_force_N": float(np.median(normal))}
    return [Finding("contact-pulls", text, spans, contact=contact.name, evidence=evidence)]


def _friction(contact: SurfaceContact, path: Path, force: Array, rows: np.ndarray, log: Log) -> list[Finding]:
    """Regression of the force along the sliding direction on speed and normal force."""
    n, v = path.normal[rows], path.v[rows]
    along = v - (v * n).sum(axis=1, keepdims=True) * n
    speed = np.linalg.norm(along, axis=1)
    sliding = speed > SLOW
    if sliding.sum() < LEAST_ROWS:
        return []
    drag = -(force * along).sum(axis=1)[sliding] / speed[sliding]
    press = np.maximum((force * n).sum(axis=1)[sliding], 0.0)
    block = blocks_of(len(drag))
    # One coefficient per block, so that the scatter between blocks tells how sure it is.
    each = [
        (drag[block == k] @ press[block == k]) / max(press[block == k] @ press[block == k], 1e-12)
        for k in range(8)
    ]
    mean, error = float(np.mean(each)), float(np.std(each, ddof=1) / np.sqrt(8))
    if mean <= SIGNIFICANT * error:
        return []
    text = f"friction at {contact.name!r} is {100 * mean:.2g} % of the normal force while it slides"
    spans = intervals(log.contact[contact.name])
    evidence = {"friction_coefficient": mean, "standard_error": error}
    return [Finding("contact-friction", text, spans, contact=contact.name, evidence=evidence)]


def _directions(contact: SurfaceContact, path: Path, log: Log) -> list[Finding]:
    """Sliding along one line only leaves friction across it unknown."""
    v = path.v[log.contact[contact.name] & log.usable]
    size = np.linalg.svd(v.T @ v / len(v), compute_uv=False)
    if size[1] > NARROW**2 * size[0]:
        return []
    text = f"the tip slides along one direction of {contact.name!r} only; friction across it is not seen"
    spans = intervals(log.contact[contact.name])
    evidence = {"share_across": float(np.sqrt(size[1] / max(size[0], 1e-300)))}
    return [Finding("force-directions", text, spans, contact=contact.name, evidence=evidence)]
