"""Motion of unlogged joints derived from a closed contact, and speeds below which a contact sticks.

**Joints without a column.** A closed contact satisfies c(q) = 0, A q̇ = 0 and A q̈ = b. Let u denote the
unknown joints and o the logged joints. Gauss-Newton iterations solve c(q_o, q_u) = 0 for q_u. Then

    q̇_u = −A_u⁺ A_o q̇_o,   q̈_u = A_u⁺ (b − A_o q̈_o).

**Sticking.** If a contact point sometimes sticks and sometimes slides, the logarithm of its speed has two
modes. The tip sticks below the valley between them, even if it creeps by a few mm/s, as in MuJoCo. A sliding
tip that reverses is slow in a few rows, but these do not form a mode.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.errors import DataError
from forcegp.logs.contact import SLIDING
from forcegp.logs.gather import STICKS
from forcegp.logs.mapping import Mapping
from forcegp.logs.table import Array, ImportReport, Signals

STEPS, SOLVED = 50, 1e-9
"""Maximum number of Gauss-Newton steps, and largest accepted constraint error [m]."""
UNMOVED = 1e-6
"""Ratio of the smallest singular value of A_u to the largest of A above which contacts determine joints."""
BINS, SMOOTH = 10, 1.5
"""Number of bins per decade of speed, and standard deviation of the smoothing kernel, in bins."""
VALLEY, SHARE = 0.5, 0.1
"""Maximum height of a valley relative to the lower mode; minimum fraction of rows on either side, since a tip
that pauses only when it reverses does not stick."""
SLOWEST = 1e-6
"""Lower bound to which speeds are clamped [m/s]."""
REST_MEDIANS = 3.4
"""Ratio of the largest speed of a tip that always rests, whose apparent speed is noise, to its median: four
standard deviations of each of two components."""


def derive_joints(
    signals: Signals, system: ConstrainedSystem, mapping: Mapping, report: ImportReport
) -> None:
    """Fill in the positions of the joints listed in `from_contact`, and their derivatives if logged. Drop the
    rows in which the contact is open.

    Raises:
        MappingError: the contact does not exist, or its state cannot be determined without the position.
        DataError: a contact does not determine its joints.
    """
    asked = mapping.sections.position.from_contact
    if not asked:
        return
    key = ("position", "from_contact")
    closed = np.ones(len(signals), dtype=bool)
    for joint, name in asked.items():
        if name not in system.contact_names:
            listing = ", ".join(system.contact_names) or "no contacts"
            raise mapping.error((*key, joint), f"the scene has no contact {name!r}", listing)
        section = mapping.sections.contact.get(name)
        if section is None or section.source not in ("always", "column"):
            text = f"the state of contact {name!r} needs the position of {joint!r}"
            expected = f'[contact.{name}] source = "always" or "column"'
            raise mapping.error((*key, joint), text, expected)
        if section.source == "column":
            closed &= signals.contact[name]
    if not closed.all():
        report.find("open", f"{(~closed).sum()} rows were dropped: an open contact tells no joint")
        signals.keep(closed, split=True)
    unknown = [signals.joint_names.index(joint) for joint in asked]
    contacts = map(system.contact, dict.fromkeys(asked.values()))
    slides = [replace(c, stick_speed=None) if isinstance(c, SurfaceContact) else c for c in contacts]
    logged = {name: signals.vectors[name] for name in ("q", "qd", "qdd") if name in signals.vectors}
    vectors = {name: torch.from_numpy(value) for name, value in logged.items()}
    solved = _solve(replace(system, contacts=slides), vectors, unknown, tuple(asked))
    signals.vectors |= {name: value.numpy() for name, value in solved.items()}
    report.steps.append("; ".join(f"{joint} follows from contact {name!r}" for joint, name in asked.items()))


def _solve(
    system: ConstrainedSystem, vectors: dict[str, Tensor], u: list[int], joints: tuple[str, ...]
) -> dict[str, Tensor]:
    """Return q, q̇ and q̈ (n, nq), as far as logged, with the joints u such that the contacts stay closed."""
    robot, q = system.robot, vectors["q"].clone()
    zero = torch.zeros_like(q)
    middle = 0.5 * (robot.lower + robot.upper)
    q[:, u] = torch.where(middle.isfinite(), middle, 0.0)[u]
    step, eom = q, system.equations(q, zero)
    for _ in range(STEPS):
        step = torch.linalg.lstsq(eom.A[..., u], eom.c[..., None]).solution[..., 0]
        q[:, u] -= step
        eom = system.equations(q, zero)
        if float(step.abs().max()) < SOLVED:
            break
    A = eom.A
    moved = torch.linalg.svdvals(A[..., u])[..., -1] > UNMOVED * torch.linalg.svdvals(A)[..., 0]
    if not bool(moved.all()) or not float(step.abs().max()) < SOLVED or float(eom.c.abs().max()) > SOLVED:
        raise DataError(
            f"the contact does not determine {', '.join(joints)}",
            expected=f"positions within {STEPS} Gauss-Newton steps that close the contact in every row",
            got=f"{float(eom.c.abs().max()):.3g} m of distance left",
            hint="check the place of the surface, and that the joint moves the point along its normal",
        )
    solved = {"q": q}
    if "qd" in vectors:
        solved["qd"] = qd = vectors["qd"].clone()
        qd[:, u] = 0.0
        qd[:, u] = -torch.linalg.lstsq(A[..., u], A @ qd[..., None]).solution[..., 0]
        if "qdd" in vectors:
            solved["qdd"] = qdd = vectors["qdd"].clone()
            qdd[:, u] = 0.0
            residual = system.equations(q, qd).b[..., None] - A @ qdd[..., None]
            qdd[:, u] = torch.linalg.lstsq(A[..., u], residual).solution[..., 0]
    return solved


@torch.no_grad()
def stick_speeds(
    signals: Signals, system: ConstrainedSystem, mapping: Mapping, report: ImportReport
) -> dict[str, float]:
    """Return the speed below which each surface contact sticks [m/s], from the mapping or the log."""
    speeds: dict[str, float] = {}
    for contact in system.contacts:
        section, closed = mapping.sections.contact.get(contact.name), signals.contact.get(contact.name)
        if not isinstance(contact, SurfaceContact) or section is None or closed is None or not closed.any():
            continue
        if contact.stick_speed is not None or section.stick_speed == "never":
            continue
        rows = (np.ascontiguousarray(signals.vectors[name][closed]) for name in ("q", "qd"))
        eom = ConstrainedSystem(system.robot, [contact]).equations(*map(torch.from_numpy, rows))
        speed = eom.contact_points[contact.name].sliding[1].norm(dim=-1).numpy()
        flag = signals.vectors.get(f"{STICKS}{contact.name}")
        if section.stick_speed != "auto":
            limit = section.stick_speed
        elif flag is not None:
            limit = dividing_speed(speed, flag[closed, 0] >= 0.5)
        else:
            limit = resting_speed(speed)
        if limit is not None:
            speeds[contact.name] = limit
            share, other = 100.0 * (speed < limit).mean(), f'"never" under [contact.{contact.name}]'
            text = f"contact {contact.name!r} sticks below {1e3 * limit:.3g} mm/s, {share:.0f} % of its rows"
            report.find("sticks", f"{text}; stick_speed = {other} if it slides")
    return speeds


def resting_speed(speed: Array) -> float | None:
    """Return the speed that separates rows at rest from rows in motion, or `None` if the tip never rests.

    Args:
        speed: speed of the contact point along the surface `(n,)` [m/s].

    >>> creeps, slides = np.geomspace(1e-4, 3e-3, 100), np.geomspace(0.05, 0.2, 300)
    >>> 3e-3 < resting_speed(np.concatenate([creeps, slides])) < 0.05
    True
    >>> resting_speed(slides) is None
    True
    """
    x = np.log10(np.maximum(speed, SLOWEST))
    edges = np.arange(np.floor(x.min()), np.ceil(x.max()) + 1.0 / BINS, 1.0 / BINS)
    rows, edges = np.histogram(x, edges if len(edges) > 1 else 1)
    density = gaussian_filter1d(rows.astype(float), SMOOTH, mode="constant")
    left, right = np.maximum.accumulate(density), np.maximum.accumulate(density[::-1])[::-1]
    depth = density / np.maximum(np.minimum(left, right), np.finfo(float).tiny)
    below = (np.cumsum(rows) - 0.5 * rows) / len(x)
    depth[(below < SHARE) | (below > 1.0 - SHARE)] = 1.0
    if depth.min() <= VALLEY:
        # Take the middle of the deepest bins, since an empty valley has several.
        deepest = np.flatnonzero(depth <= depth.min() + 1e-12)
        return float(10.0 ** (0.5 * (edges[deepest[0]] + edges[deepest[-1] + 1])))
    usual = float(np.median(speed))
    return max(SLIDING, REST_MEDIANS * usual) if usual < SLIDING else None


def dividing_speed(speed: Array, sticks: NDArray[np.bool_]) -> float | None:
    """Return the speed that separates sticking from other rows with the fewest errors."""
    if not sticks.any():
        return None
    order = np.argsort(speed)
    # The errors for a threshold above the k slowest rows are sliding rows below and sticking rows above it.
    slide = np.concatenate([[0], np.cumsum(~sticks[order])])
    wrong = slide + sticks.sum() - (np.arange(len(slide)) - slide)
    k, ranked = int(np.argmin(wrong)), np.append(speed[order], 2.0 * speed.max())
    return max(float(0.5 * (ranked[max(k - 1, 0)] + ranked[k])), SLOWEST)
