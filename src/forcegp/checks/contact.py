"""Does the tip touch the surface of the scene where the log says so, and what force does a contact carry?

The surface must push, and friction opposes the sliding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from forcegp import kinematics
from forcegp.checks.finding import Finding, Intervals
from forcegp.checks.fit import CHUNK, blocks_of, residual, tensors
from forcegp.checks.log import Array, Log, Outcome, describe, evenly, intervals
from forcegp.constraints import ConstrainedSystem, Plane, SurfaceContact
from forcegp.robust import robust_std

OFFSET = 5e-4
"""Displacement of a surface that is reported [m]."""
TILT = np.radians(0.2)
"""Tilt of a surface that is reported [rad]."""
FAR = 0.01
"""Displacement of all contact rows that no calibration explains: another surface, point or label [m]."""
TOUCH = 2e-4
"""Distance within which a tip touches, at least: surfaces and arms are no stiffer [m]."""
ROUGH = 8.0
"""Robust standard deviations of the distance in contact within which a tip touches."""
LANDING = 5
"""Rows within which a tip that lands stops."""
CREEP = 1e-3
"""Speed along the normal that a touching tip may have, at least [m/s]."""
STOPS = 2.0
"""Factor by which a landing tip is faster than one that rests."""
DRIFT = 2e-3
"""Distance that a tip may gain and lose while it touches: soft ground, a bent arm, a drift [m]."""
RUN_SECONDS = 0.02
"""Shortest run of rows that a wrong label is reported for [s]."""
MISSED_SECONDS = 0.1
"""Shortest time along the surface that counts as a contact that was not labelled [s]."""
MISSED_DISTANCE = 2e-3
"""The tip must slide this far along the surface to count as in contact [m]."""
LEAST_ROWS = 20


@dataclass(frozen=True)
class Path:
    """Motion of the touching point of one contact.

    Attributes:
        c: `(n,)` distance from the surface of the scene [m].
        p, v: `(n, 3)` position and velocity in the world [m], [m/s].
        normal: `(n, 3)` out of the solid.
    """

    c: Array
    p: Array
    v: Array
    normal: Array

    @property
    def approach(self) -> Array:
        """Speed along the normal `(n,)` [m/s]."""
        return np.abs((self.v * self.normal).sum(axis=1))


def tip_path(system: ConstrainedSystem, contact: SurfaceContact, log: Log) -> Path:
    """Where the touching point was; NaN in rows that are not finite."""
    n = len(log)
    path = Path(np.full(n, np.nan), *(np.full((n, 3), np.nan) for _ in range(3)))
    rows = np.flatnonzero(log.finite)
    with torch.no_grad():
        for part in np.array_split(rows, max(1, -(-len(rows) // CHUNK))):
            q, qd = tensors(log, part, "q", "qd")
            p = kinematics.point_position(system.robot, q, contact.frame, contact.point)
            path.p[part] = p.numpy()
            path.v[part] = kinematics.point_velocity(
                system.robot, q, qd, contact.frame, contact.point
            ).numpy()
            path.c[part] = contact.center_surface.value(p).numpy()
            path.normal[part] = contact.surface.gradient(p).numpy()
    return path


def check_contacts(system: ConstrainedSystem, log: Log) -> Outcome:
    """Contact labels against the distance of the tip from the surface, contact by contact."""
    findings = []
    for contact in system.contacts:
        if contact.name not in log.contact:
            text = f"the scene has a contact {contact.name!r}, and the log does not say when it is closed"
            findings.append(Finding("contact-unlabelled", text, log.all_rows, contact=contact.name))
        elif isinstance(contact, SurfaceContact):
            findings += _check_surface(contact, tip_path(system, contact, log), log)
    return findings, log


def _check_surface(contact: SurfaceContact, path: Path, log: Log) -> list[Finding]:
    usable = np.isfinite(path.c) & log.usable
    closed = log.contact[contact.name] & usable
    if closed.sum() < LEAST_ROWS:
        return _missed(contact, path, usable & ~closed & (path.approach <= CREEP), path.c, TOUCH, log)
    findings, distance = _placement(contact, path, closed, log)
    rough = ROUGH * float(robust_std(distance[closed]))
    return [*findings, *_labels(contact, path, closed, usable, distance, rough, log)]


def _placement(
    contact: SurfaceContact, path: Path, closed: np.ndarray, log: Log
) -> tuple[list[Finding], Array]:
    """Displacement and tilt of the surface, and the distance from it once they are undone."""
    offset, tilt, shift = fit_surface(contact, path, closed)
    rows = intervals(closed)
    name, evidence = contact.name, {"offset_m": offset, "tilt_deg": float(np.degrees(np.linalg.norm(tilt)))}
    distance = path.c - shift
    if abs(np.median(path.c[closed])) > FAR:
        text = f"in contact {name!r} the tip is {1e3 * np.median(path.c[closed]):+.3g} mm from the surface"
        return [Finding("contact-far", text, rows, contact=name, evidence=evidence)], distance
    findings = []
    if np.linalg.norm(tilt) > TILT:
        text = f"the surface of {name!r} is tilted by {evidence['tilt_deg']:.3g}° against the tip's path"
        evidence |= {f"slope_{axis}": float(value) for axis, value in zip("xyz", tilt, strict=True)}
        findings.append(Finding("surface-tilted", text, rows, contact=name, evidence=evidence))
    if abs(offset) > OFFSET:
        text = f"the surface of {name!r} lies {1e3 * offset:+.3g} mm along its normal from the scene's"
        findings.append(Finding("surface-offset", text, rows, contact=name, evidence={"offset_m": offset}))
    return findings, distance if findings else path.c


def fit_surface(contact: SurfaceContact, path: Path, closed: np.ndarray) -> tuple[float, Array, Array]:
    """Offset in the middle of the path [m], slope along the surface `(3,)`, distance they make `(n,)`.

    Rows that stay off the fit, such as those labelled too early, are trimmed round by round.
    """
    p = path.p - np.median(path.p[closed], axis=0)
    keep, slope, theta = closed.copy(), np.zeros(3), np.zeros(3)
    offset = float(np.median(path.c[closed]))
    if not isinstance(contact.surface, Plane):
        return offset, slope, np.full(len(p), offset)
    n = np.asarray(contact.surface.normal)
    tangent = np.linalg.svd(n[None])[2][1:]
    x = p @ tangent.T
    for _ in range(10):
        A = np.column_stack([x[keep], np.ones(keep.sum())])
        # Directions along which the tip hardly moves do not show a tilt.
        theta = np.linalg.lstsq(A, path.c[keep], rcond=1e-3)[0]
        rest = path.c - x @ theta[:2] - theta[2]
        limit = max(TOUCH, 4.0 * float(robust_std(rest[keep])))
        trimmed = closed & (np.abs(rest) <= limit)
        if trimmed.sum() < max(LEAST_ROWS, 0.5 * closed.sum()) or (trimmed == keep).all():
            break
        keep = trimmed
    slope = theta[:2] @ tangent
    if np.linalg.norm(slope) <= TILT:
        offset = float(np.median(path.c[keep]))
        return offset, np.zeros(3), np.full(len(p), offset)
    return float(theta[2]), slope, x @ theta[:2] + theta[2]


def _labels(
    contact: SurfaceContact,
    path: Path,
    closed: np.ndarray,
    usable: np.ndarray,
    c: Array,
    rough: float,
    log: Log,
) -> list[Finding]:
    """Rows labelled closed off the surface, by their place in the interval, and open ones that slide."""
    touch, moving = max(TOUCH, rough), closed & (np.linalg.norm(path.v, axis=1) > CREEP)
    slow = max(CREEP, ROUGH * float(robust_std(path.approach[moving])) if moving.any() else 0.0)
    texts = {
        "contact-early": "labelled closed before the tip touches",
        "contact-late": "labelled closed after the tip has left",
        "contact-far": "labelled closed while the tip is off the surface",
    }
    findings = []
    for kind, spans in _runs_off(path.approach, closed, c, touch, slow, log).items():
        if spans:
            rows: Intervals = tuple(spans)
            most = max(float(np.abs(c[a:b]).max()) for a, b in rows)
            where = f"by up to {1e3 * most:.3g} mm, in {describe(rows)}"
            text = f"contact {contact.name!r} is {texts[kind]}, {where}"
            findings.append(Finding(kind, text, rows, contact=contact.name, evidence={"distance_m": most}))
    slides = usable & ~closed & (path.approach <= slow)
    return [*findings, *_missed(contact, path, slides, c, touch, log)]


def _runs_off(
    approach: Array, closed: np.ndarray, c: Array, touch: float, slow: float, log: Log
) -> dict[str, list[tuple[int, int]]]:
    """Runs of rows labelled closed off the surface, by kind of finding.

    A run is found where the tip is farther off than surfaces and arms give way. It reaches to the row
    at which the tip moves along the normal no faster than in the rest of the contact.
    """
    settled = approach <= slow
    least = max(2, round(RUN_SECONDS / log.dt)) if np.isfinite(log.dt) else 2
    off = closed & (np.abs(c) > touch)
    runs: dict[str, list[tuple[int, int]]] = {"contact-early": [], "contact-late": [], "contact-far": []}
    for start, stop in intervals(closed):
        for a, b in intervals(off[start:stop], join=least):
            if b - a >= least:
                kind = "contact-early" if a == 0 and b < stop - start else "contact-late"
                inside = (a > 0 and b < stop - start) or (a == 0 and b == stop - start)
                if inside and float(np.abs(c[start + a : start + b]).max()) <= max(DRIFT, touch):
                    continue
                if not inside:
                    a, b = _until_settled(a, b, settled[start:stop])
                far = float(np.abs(c[start + a : start + b]).max()) > max(DRIFT, touch)
                # A tip that lands stops at once; a constraint missed by a little is approached slowly.
                landing = approach[start + max(a, b - LANDING) : start + b].max()
                if kind == "contact-early" and not far and landing <= STOPS * slow:
                    continue
                runs["contact-far" if inside else kind].append((start + a, start + b))
    return runs


def _until_settled(a: int, b: int, settled: np.ndarray) -> tuple[int, int]:
    """A run at the start or the end of an interval, extended to where the tip settles."""
    if a == 0:
        return a, b + int(np.argmax(settled[b:])) if settled[b:].any() else b
    return (a - int(np.argmax(settled[:a][::-1])) if settled[:a].any() else a), b


def _missed(
    contact: SurfaceContact, path: Path, open_: np.ndarray, c: Array, touch: float, log: Log
) -> list[Finding]:
    """Rows labelled open in which the tip slides along the surface.

    A tip that takes off gently is near for a while, but soon moves along the normal faster than in contact.
    """
    if not np.isfinite(log.dt):
        return []
    near = open_ & (np.abs(c) <= touch)
    along = path.v - (path.v * path.normal).sum(axis=1, keepdims=True) * path.normal
    speed = np.linalg.norm(along, axis=1)
    least = max(3, round(MISSED_SECONDS / log.dt))
    spans = tuple(
        (a, b)
        for a, b in intervals(near)
        if b - a >= least and speed[a:b].sum() * log.dt > MISSED_DISTANCE + 20.0 * np.ptp(c[a:b])
    )
    if not spans:
        return []
    text = f"the tip slides on the surface of {contact.name!r} while labelled open, in {describe(spans)}"
    return [Finding("contact-missed", text, spans, contact=contact.name)]


FORCE_ROWS = 4000
"""Contact rows whose force is computed."""
PULLS = 0.5
"""Share of contact rows with a pulling force from which the normal must be the wrong way round."""
SIGNIFICANT = 4.0
"""Standard errors over blocks from which friction is there."""
SLIDING_SLOW = 0.01
"""Speed below which the direction of sliding is unknown [m/s]."""
NARROW = 0.05
"""Share of the sliding motion that the second direction must have."""


def check_forces(system: ConstrainedSystem, log: Log) -> Outcome:
    """Normal force, friction and directions of sliding of each contact, where the arm can tell the force."""
    findings = []
    for contact in system.contacts:
        if isinstance(contact, SurfaceContact) and contact.name in log.contact:
            path = tip_path(system, contact, log)
            rows = np.flatnonzero(log.contact[contact.name] & log.usable)
            rows = evenly(rows, FORCE_ROWS)
            if len(rows) >= LEAST_ROWS:
                findings += _directions(contact, path, log)
                force = _force(replace(system, contacts=[contact]), log, rows, path)
                pulls = _pulls(contact, path, force, rows, log)
                findings += pulls or (_friction(contact, path, force, rows, log) if log.nq > 3 else [])
    return findings, log


def _force(system: ConstrainedSystem, log: Log, rows: np.ndarray, path: Path) -> Array:
    """Force `(n, 3)` at the touching point that explains the torque best, r = Jᵀ F.

    With three torques or fewer, which any force would explain, it is the best one along the normal, r = Aᵀ λ.
    """
    remainder = residual(system, log, rows)
    if log.nq <= 3:
        A = remainder.J[:, 0]
        size = np.maximum((A * A).sum(axis=1), 1e-12)
        return ((A * remainder.r).sum(axis=1) / size)[:, None] * path.normal[rows]
    gram = remainder.J @ remainder.J.transpose(0, 2, 1)
    return np.linalg.solve(gram + 1e-9 * np.eye(3), (remainder.J @ remainder.r[..., None]))[..., 0]


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
    sliding = speed > SLIDING_SLOW
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
