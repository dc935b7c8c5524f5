"""Checks of contact labels against the distance between tip and surface, and checks of contact forces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import torch

from forcegp import kinematics
from forcegp.checks.finding import Finding, with_alternatives
from forcegp.checks.fit import BLOCKS, CHUNK, blocks_of, labelled_contacts, residual
from forcegp.checks.log import Array, Log, Outcome, evenly
from forcegp.constraints import ConstrainedSystem, Plane, SurfaceContact
from forcegp.logs.closed import TOUCHING
from forcegp.logs.contact import LEVEL
from forcegp.robust import level_of, robust_std
from forcegp.rows import Intervals, describe, intervals

OFFSET, TILT = 5e-4, np.radians(0.2)
"""Smallest displacement [m] and tilt [rad] of a surface that are reported."""
FAR = 0.01
"""Median distance in contact above which the surface, the contact point or the labels must be wrong [m]."""
TOUCH, ROUGH = 2e-4, 8.0
"""A tip counts as touching within this distance, which allows for compliant surfaces and arms. It is given in
m and in robust standard deviations of the distance in contact."""
CREEP = 1e-3
"""Speed along the normal that is always accepted in contact [m/s]."""
LANDING, STOPS = 5, 2.0
"""Number of rows within which a landing tip stops, and ratio of its speed to that of a tip in contact."""
DRIFT, RUN_SECONDS = 2e-3, 0.02
"""Accepted change in distance during contact, caused by soft ground, deflection of the arm, or drift [m].
Duration of the shortest run of rows for which a wrong label is reported [s]."""
MISSED_SECONDS, MISSED_DISTANCE = 0.1, 2e-3
"""Minimum duration [s] and distance [m] of sliding along the surface for an unlabelled contact."""
LEAST_ROWS = 20
"""Minimum number of rows in contact for judging a contact or its force."""
OFF = {
    "contact-early": "labelled closed before the tip touches",
    "contact-late": "labelled closed after the tip has left",
    "contact-far": "labelled closed while the tip is off the surface",
}
"""For each kind of finding, a description of rows labelled closed although the tip is off the surface."""


@dataclass(frozen=True)
class Path:
    """Path of a contact point: signed distance `c` from the surface in the scene, shape (n,) [m]; position
    `p` [m], velocity `v` [m/s] and surface normal `normal` in the world, shape (n, 3)."""

    c: Array
    p: Array
    v: Array
    normal: Array

    @cached_property
    def approach(self) -> Array:
        """Absolute speed along the normal `(n,)` [m/s]."""
        return np.abs((self.v * self.normal).sum(axis=1))

    @cached_property
    def along(self) -> Array:
        """Velocity along the surface `(n, 3)` [m/s]."""
        return self.v - (self.v * self.normal).sum(axis=1, keepdims=True) * self.normal


def tip_path(
    system: ConstrainedSystem, contact: SurfaceContact, log: Log, rows: np.ndarray | None = None
) -> Path:
    """Return the path of the contact point at the given (or all) rows, with NaN in non-finite rows."""
    parts = np.array_split(np.arange(len(log)) if rows is None else rows, -(-len(log) // CHUNK))
    paths = []
    with torch.no_grad():
        for q, qd in (log.tensors(part, "q", "qd") for part in parts):
            p = kinematics.point_position(system.robot, q, contact.frame, contact.point)
            v = kinematics.point_velocity(system.robot, q, qd, contact.frame, contact.point)
            paths.append((contact.center_surface.value(p), p, v, contact.surface.gradient(p)))
    path = Path(*(np.concatenate(part) for part in zip(*paths, strict=True)))
    for value in (path.c, path.p, path.v, path.normal) if rows is None else ():
        value[~log.finite] = np.nan
    return path


def touching(system: ConstrainedSystem, log: Log) -> Iterator[tuple[SurfaceContact, np.ndarray]]:
    """Yield each surface contact that is labelled closed in enough rows, together with these rows."""
    for contact in labelled_contacts(system, log):
        rows = np.flatnonzero(log.contact[contact.name] & log.usable)
        if isinstance(contact, SurfaceContact) and len(rows) >= LEAST_ROWS:
            yield contact, rows


def check_contacts(system: ConstrainedSystem, log: Log) -> Outcome:
    """Check the contact labels against the distance between the tip and the surface."""
    findings = []
    for contact in system.contacts:
        if contact.name not in log.contact:
            text = f"the scene has a contact {contact.name!r}, but the log does not contain its state"
            findings.append(Finding("contact-unlabelled", text, log.all_rows, contact=contact.name))
        elif isinstance(contact, SurfaceContact):
            path = tip_path(system, contact, log)
            usable = np.isfinite(path.c) & log.usable
            closed = log.contact[contact.name] & usable
            if closed.sum() >= LEAST_ROWS:
                placement, distance = _placement(contact, path, closed)
                findings += [*placement, *_labels(contact, path, closed, usable, distance, log)]
            else:
                slides = usable & ~closed & (path.approach <= CREEP)
                missed = _missed(contact, path, slides, path.c, TOUCH, log)
                findings += missed or _beside(contact, path, usable)
    return findings, log


def _beside(contact: SurfaceContact, path: Path, usable: np.ndarray) -> list[Finding]:
    """Report a tip that stays at a constant distance from the surface although the contact never closes."""
    rows = usable & (np.linalg.norm(path.along, axis=1) > SLIDING_SLOW)
    level = level_of(path.c[rows], TOUCHING, LEVEL)
    if level is None or abs(level) <= TOUCHING:
        return []
    spread = 1e3 * float(robust_std(path.c[rows & (np.abs(path.c - level) <= TOUCHING)]))
    text = (
        f"contact {contact.name!r} is never closed, but the tip slides {1e3 * level:.3g} ± {spread:.2g} "
        "mm from its surface: it may be there (`forcegp import --fit-surface`), or the motion is free"
    )
    # A tip may hover over a surface, but not move inside the solid.
    weight = "error" if level < 0.0 else "warning"
    return [Finding("contact-far", text, intervals(rows), (), contact.name, {"offset_m": level}, weight)]


def _placement(contact: SurfaceContact, path: Path, closed: np.ndarray) -> tuple[list[Finding], Array]:
    """Return findings on displacement and tilt of the surface, and distances from the corrected surface."""
    offset, tilt, shift = fit_surface(contact, path, closed)
    name, evidence = contact.name, {"offset_m": offset, "tilt_deg": float(np.degrees(np.linalg.norm(tilt)))}
    finding = partial(Finding, intervals=intervals(closed), contact=name)
    if abs(middle := np.median(path.c[closed])) > FAR:
        text = f"in contact {name!r} the tip is {1e3 * middle:+.3g} mm from the surface"
        return [finding("contact-far", text, evidence=evidence)], path.c - shift
    findings = []
    if np.linalg.norm(tilt) > TILT:
        text = f"the surface of {name!r} is tilted by {evidence['tilt_deg']:.3g}° against the tip's path"
        slopes = {f"slope_{axis}": float(value) for axis, value in zip("xyz", tilt, strict=True)}
        findings.append(finding("surface-tilted", text, evidence=evidence | slopes))
    if abs(offset) > OFFSET:
        text = f"the surface of {name!r} lies {1e3 * offset:+.3g} mm along its normal from the scene's"
        findings.append(finding("surface-offset", text, evidence={"offset_m": offset}))
    return findings, path.c - shift if findings else path.c


def fit_surface(contact: SurfaceContact, path: Path, closed: np.ndarray) -> tuple[float, Array, Array]:
    """Fit a surface, ignoring outliers; return offset [m], slope (3,) and the distances (n,) from it."""
    offset = float(np.median(path.c[closed]))
    if not isinstance(contact.surface, Plane):
        return offset, np.zeros(3), np.full(len(path.c), offset)
    tangent = np.linalg.svd(np.asarray(contact.surface.normal)[None])[2][1:]
    x = (path.p - np.median(path.p[closed], axis=0)) @ tangent.T
    keep, theta = closed, np.zeros(3)
    for _ in range(10):
        A = np.column_stack([x[keep], np.ones(keep.sum())])
        # A tilt has no effect along directions in which the tip hardly moves.
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
        return offset, np.zeros(3), np.full(len(x), offset)
    return float(theta[2]), slope, x @ theta[:2] + theta[2]


def _labels(
    contact: SurfaceContact, path: Path, closed: np.ndarray, usable: np.ndarray, c: Array, log: Log
) -> list[Finding]:
    """Find rows labelled closed with the tip off the surface, and rows labelled open while the tip slides."""
    touch = max(TOUCH, ROUGH * float(robust_std(c[closed])))
    moving = closed & (np.linalg.norm(path.v, axis=1) > CREEP)
    slow = max(CREEP, ROUGH * float(robust_std(path.approach[moving])) if moving.any() else 0.0)
    findings = []
    # Rows that are masked, as at the impact of a landing tip, do not end an interval.
    label, off = log.contact[contact.name] & np.isfinite(c), closed & (np.abs(c) > touch)
    for kind, rows in _runs_off(path.approach, label, off, c, touch, slow, log).items():
        if rows:
            most = max(float(np.abs(c[a:b]).max()) for a, b in rows)
            where = f"by up to {1e3 * most:.3g} mm, in {describe(rows)}"
            text = f"contact {contact.name!r} is {OFF[kind]}, {where}"
            findings.append(Finding(kind, text, rows, contact=contact.name, evidence={"distance_m": most}))
    return [*findings, *_missed(contact, path, usable & ~closed & (path.approach <= slow), c, touch, log)]


def _runs_off(
    approach: Array, label: np.ndarray, off: np.ndarray, c: Array, touch: float, slow: float, log: Log
) -> dict[str, Intervals]:
    """Return the runs of closed rows with the tip off the surface, extended until the tip settles."""
    settled = approach <= slow
    least = max(2, round(RUN_SECONDS / log.dt)) if np.isfinite(log.dt) else 2
    runs: dict[str, Intervals] = dict.fromkeys(OFF, ())
    for start, stop in intervals(label):
        for a, b in intervals(off[start:stop], join=least, least=least):
            kind = "contact-early" if a == 0 and b < stop - start else "contact-late"
            inside = (a > 0) == (b < stop - start)
            before, after = settled[start : start + a][::-1], settled[start + b : stop]
            if not inside and a == 0 and after.any():
                b += int(np.argmax(after))
            elif not inside and before.any():
                a -= int(np.argmax(before))
            far = float(np.abs(c[start + a : start + b]).max()) > max(DRIFT, touch)
            # A tip that lands stops at once; a constraint missed by a little is approached slowly.
            landing = approach[start + max(a, b - LANDING) : start + b].max() > STOPS * slow
            if far or not (inside or (kind == "contact-early" and not landing)):
                runs["contact-far" if inside else kind] += ((start + a, start + b),)
    return runs


def _missed(
    contact: SurfaceContact, path: Path, open_: np.ndarray, c: Array, touch: float, log: Log
) -> list[Finding]:
    """Find rows labelled open in which the tip slides on the surface for longer than in a gentle lift-off."""
    if not np.isfinite(log.dt):
        return []
    near, speed = open_ & (np.abs(c) <= touch), np.linalg.norm(path.along, axis=1)
    least = max(3, round(MISSED_SECONDS / log.dt))
    spans = tuple(
        (a, b)
        for a, b in intervals(near, least=least)
        if speed[a:b].sum() * log.dt > MISSED_DISTANCE + 20.0 * np.ptp(c[a:b])
    )
    if not spans:
        return []
    text = f"the tip slides on the surface of {contact.name!r} while labelled open, in {describe(spans)}"
    return [Finding("contact-missed", text, spans, contact=contact.name)]


FORCE_ROWS = 4000
"""Maximum number of contact rows at which forces are computed."""
PULLS = 0.5
"""Fraction of contact rows with a pulling force above which the normal must be reversed."""
FRICTION_Z, LARGEST_FRICTION = 4.0, 2.0
"""Standard errors over blocks above which friction is significant; largest plausible friction coefficient."""
SLIDING_SLOW, NARROW = 0.01, 0.05
"""Speed below which the direction of sliding is unknown [m/s]; minimum RMS speed across the main direction of
sliding, relative to the speed along it."""


def check_forces(system: ConstrainedSystem, log: Log) -> Outcome:
    """Check the normal force, friction and sliding directions of each contact if torques determine them."""
    findings = []
    for contact, rows in touching(system, log):
        finding = partial(Finding, intervals=intervals(log.contact[contact.name]), contact=contact.name)
        findings += _directions(finding, tip_path(system, contact, log, rows).v)
        rows = evenly(rows, FORCE_ROWS)
        path = tip_path(system, contact, log, rows)
        one = replace(system, contacts=[contact])
        force = _force(one, log, rows, path)
        if pulls := _pulls(finding, path, force):
            # With up to three joints, a contact force fits any torque, even one with the wrong sign.
            others = []
            for j, name in enumerate(log.joint_names if log.nq <= 3 else ()):
                flipped = _force(one, log.changed(("tau",), flip=(j,)), rows, path)
                if np.median((flipped * path.normal).sum(axis=1)) > 0.0:
                    text = f"the torque of {name} has the opposite sign"
                    others.append(log.finding("torque-sign", text, (name,)))
            findings.append(with_alternatives(pulls[0], others))
        elif log.nq > 3:
            findings += _friction(finding, path, force)
    return findings, log


def _force(system: ConstrainedSystem, log: Log, rows: np.ndarray, path: Path) -> Array:
    """Return the force F `(n, 3)` that best fits r = Jᵀ F, or its normal part with up to three joints."""
    r, J = residual(system, log, rows)
    if log.nq <= 3:
        A = J[:, 0] * ~np.isin(np.arange(log.nq), log.unmeasured)
        size = np.maximum((A * A).sum(axis=1), 1e-12)
        return ((A * r).sum(axis=1) / size)[:, None] * path.normal
    gram = J @ J.transpose(0, 2, 1)
    return np.linalg.solve(gram + 1e-9 * np.eye(J.shape[1]), (J @ r[..., None]))[:, :3, 0]


def _pulls(finding: partial[Finding], path: Path, force: Array) -> list[Finding]:
    normal = (force * path.normal).sum(axis=1)
    middle = float(np.median(normal))
    # The scatter holds noise and true changes alike; the force of an arm that presses stays above it.
    pulls = middle < 0.0 and (normal < 0.0).mean() > PULLS and -middle > robust_std(normal)
    text = f"the force at {finding.keywords['contact']!r} pulls with {-middle:.3g} N along the normal"
    return [finding("contact-pulls", text, evidence={"normal_force_N": middle})] if pulls else []


def _friction(finding: partial[Finding], path: Path, force: Array) -> list[Finding]:
    """Report the friction coefficient estimated from the force opposite to the direction of sliding."""
    speed = np.linalg.norm(path.along, axis=1)
    sliding = speed > SLIDING_SLOW
    if sliding.sum() < LEAST_ROWS:
        return []
    drag = -(force * path.along).sum(axis=1)[sliding] / speed[sliding]
    press = np.maximum((force * path.normal).sum(axis=1)[sliding], 0.0)
    # One coefficient per block: the scatter between blocks gives the standard error.
    each = [(drag[b] @ press[b]) / max(press[b] @ press[b], 1e-12) for b in blocks_of(len(drag))]
    mean, error = float(np.mean(each)), float(np.std(each, ddof=1) / np.sqrt(BLOCKS))
    size = "not determined" if mean > LARGEST_FRICTION else f"about {100 * mean:.0f} % of the normal force"
    text = f"friction at {finding.keywords['contact']!r} while it slides is {size}"
    evidence = {"friction_coefficient": mean, "standard_error": error}
    return [finding("contact-friction", text, evidence=evidence)] if mean > FRICTION_Z * error else []


def _directions(finding: partial[Finding], v: Array) -> list[Finding]:
    """Report sliding along a single line, which leaves friction in the other direction undetermined."""
    size, name = np.linalg.svd(v.T @ v / len(v), compute_uv=False), finding.keywords["contact"]
    text = f"the tip slides along one direction of {name!r} only; friction across it is unknown"
    evidence = {"share_across": float(np.sqrt(size[1] / max(size[0], 1e-300)))}
    return [finding("force-directions", text, evidence=evidence)] if size[1] <= NARROW**2 * size[0] else []
