"""Consistency of positions with velocities and the clock: wrapped angles, a wrong unit of time, lost rows."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d

from forcegp.data.derivative import UNIFORM_TOLERANCE
from forcegp.errors import DataError
from forcegp.kinematics import link_poses
from forcegp.logs import units
from forcegp.logs.clock import GAP_STEPS, usual_step
from forcegp.logs.table import Array, ImportReport, Signals
from forcegp.robot import RobotModel
from forcegp.robust import robust_std
from forcegp.rows import describe, numbered

TURNS = {unit: 2.0 * np.pi / units.QUANTITY["position"][unit] for unit in ("rad", "mrad", "deg", "rev")}
"""One turn in each unit of angles."""
NEAR_TURN = 0.2
"""Relative deviation from one turn of a jump by which an angle wraps. Joints move less between two rows."""
STEPS, SLOW_STEP = (1e-5, 10.0), 0.5
"""Range of the usual step of a robot's clock [s]; step above which accelerations cannot be computed [s]."""
MOST_SPEED, MOST_RATIO = 300.0, 300.0
"""Joint speed [rad/s], and ratio of velocity to dq/dt (or its inverse), that only wrong units explain."""
DOUBTED = 1.5
"""Ratio of velocity to dq/dt (or its inverse) above which import reports it. If a third of the rows was
lost, the ratio is 0.7."""
PARTS, CORRELATED = 100, 0.9
"""Fraction of the log over which displacements are compared; least correlation of such displacements."""
NEIGHBOURS, CLEAR = 11, 8.0
"""Rows in a running median; least usual step in units of the noise."""
LOST_STEP, LOST_SHARE, MANY_STEPS = 0.5, 0.002, 3.0
"""Additional steps that mean a lost row, if they occur in this share of the rows; and in a single row."""
LONGEST_PAUSE = 1.0
"""Longest gap in a log over which a jump of an angle is that of a base, and not of another motion [s]."""
BASE_JUMP, SAME_ANGLE = 0.1, 0.01
"""Least jump of the first joint, and largest difference from the angle between the links [rad]. On a real
robot with two hooks, eight jumps of 1.1 rad differ by at most 0.003 rad."""
MOST_HELD = 0.05
"""Share of held rows above which the logger is faster than its source, so that jumps are expected."""


def wrapped(q: Array, turn: Array | float) -> NDArray[np.bool_]:
    """Return the mask (n, d) of values that differ from the previous row by about one turn.

    >>> wrapped(np.array([[3.1], [-3.1], [-3.0]]), 2.0 * np.pi)[:, 0].tolist()
    [False, True, False]
    """
    jumps = np.abs(np.abs(np.diff(q, axis=0)) - turn) < NEAR_TURN * turn
    return np.concatenate([np.zeros_like(jumps, shape=(1, q.shape[1])), jumps])


def find_wrapped(signals: Signals, turn: Array, unwrap: bool, report: ImportReport) -> None:
    """Find angles that jump by `turn` (nq,) [rad], and make them continuous if requested."""
    if not np.isfinite(turn).all() or len(signals) < 2:
        return
    q = signals.vectors["q"]
    jumps = wrapped(q, turn) & np.append(False, np.diff(signals.segment) == 0)[:, None]
    if not jumps.any():
        return
    joints = ", ".join(np.array(signals.joint_names)[jumps.any(axis=0)])
    rows = np.flatnonzero(jumps.any(axis=1))
    done = "were made continuous" if unwrap else "unwrap = true under [position] makes them continuous"
    message = f"angles of {joints} jump by one turn in {len(rows)} rows: {done}"
    report.find("unwrapped" if unwrap else "wrapped", message, signals.row[rows])
    if unwrap:
        whole = np.where(jumps, np.sign(np.diff(q, axis=0, prepend=q[:1])), 0.0)
        for part in signals.runs():
            q[part] -= turn * np.cumsum(whole[part], axis=0)


def check_clock(signals: Signals, revolute: NDArray[np.bool_], report: ImportReport) -> None:
    """Raise `DataError` if the unit of time is wrong by orders of magnitude, according to the step of the
    clock, the logged velocities, or the speed of revolute joints, in this order.
    """
    step = usual_step(signals.t)
    hint = 'unit = "s", "ms", "us", "ns", "min", "h" or "d" under [time]'
    if not STEPS[0] <= step <= STEPS[1]:
        text = f"the unit of time is wrong: the usual step is {step:.3g} s"
        raise DataError(text, expected=f"{STEPS[0]:g} to {STEPS[1]:g} s for the log of a robot", hint=hint)
    if step > SLOW_STEP:
        message = f"the usual step of the clock is {step:.3g} s: accelerations cannot be computed from it"
        report.find("clock", message)
    t, q = signals.t, signals.vectors["q"]
    longest = max(rows.stop - rows.start for rows in signals.runs())
    lag = max(1, min(len(t) // PARTS, longest // 2))
    rows = np.flatnonzero(signals.segment[lag:] == signals.segment[:-lag])
    moved, time = q[rows + lag] - q[rows], (t[rows + lag] - t[rows])[:, None]
    if "qd" in signals.vectors:
        ratio = _velocity_ratio(signals, rows, lag, moved)
        if ratio is not None and not 1.0 / MOST_RATIO < ratio < MOST_RATIO:
            text = f"the unit of time or of the velocity is wrong: q̇ is {ratio:.3g} times the derivative of q"
            raise DataError(text, expected="about 1", got=f"a usual step of {step:.3g} s", hint=hint)
        if ratio is not None and not 1.0 / DOUBTED < ratio < DOUBTED:
            message = (
                f"q̇ is {ratio:.3g} times the derivative of q: check the units of time and of the velocity"
            )
            report.find("velocity", message)
    elif revolute.any() and len(rows):
        speed = float(np.quantile(np.abs(moved / time)[:, revolute], 0.9, axis=0).max())
        if speed > MOST_SPEED:
            text = f"the unit of time or of the position is wrong: joints turn at {speed:.3g} rad/s"
            expected = f"at most {MOST_SPEED:g} rad/s"
            raise DataError(text, expected=expected, got=f"a usual step of {step:.3g} s", hint=hint)


def check_base(signals: Signals, robot: RobotModel) -> None:
    """Raise `DataError` if the base changes along the log, as of a robot that swings hand over hand.

    If the last link n becomes the base, the first joint counts from it and all other joints go on. With the
    rotation D = R_1ᵀ R_n between the links, relative to that at q = 0, the first link jumps from R_1 to R_1 D
    or R_1 Dᵀ, up to half a turn.
    """
    q, t = signals.vectors["q"], signals.t
    slopes = np.diff(q, axis=0) / np.where(np.diff(t) > 0.0, np.diff(t), np.inf)[:, None]
    before, after = np.roll(slopes, 1, axis=0), np.roll(slopes, -1, axis=0)
    beyond = np.abs(np.diff(q, axis=0)) - np.maximum(np.abs(before), np.abs(after)) * np.diff(t)[:, None]
    goes_on = (np.diff(t) > 0.0) & (np.diff(t) < LONGEST_PAUSE)
    jumps = goes_on & (beyond[:, 0] > BASE_JUMP) & (np.abs(np.diff(q[:, 1:], axis=0)) < BASE_JUMP).all(axis=1)
    rows = np.flatnonzero(jumps)
    if robot.nq < 2 or not len(rows):
        return
    R = link_poses(robot, torch.from_numpy(np.concatenate([0.0 * q[:1], q[rows], q[rows + 1]]))).R
    R = R.permute(3, 2, 0, 1).numpy()
    R = R[1:] @ R[0].swapaxes(-1, -2)
    old, new = R[: len(rows)], R[len(rows) :, 0]
    first = old[:, 0].swapaxes(-1, -2)
    changes = np.zeros(len(rows), dtype=bool)
    for leaf in set(range(1, robot.nq)) - set(robot.parents):
        D = first @ old[:, leaf]
        for turn in (D, D.swapaxes(-1, -2)):
            turned = _half_turns(first @ new @ turn.swapaxes(-1, -2)) < SAME_ANGLE
            changes |= turned & (_half_turns(D) > BASE_JUMP)
    if changes.any():
        places = describe(numbered(signals.row[rows[changes] + 1]))
        raise DataError(
            f"the base of the robot changes in {places}: the angle of {robot.joint_names[0]!r} jumps by that "
            "between the first and the last link, while all other joints go on",
            expected="one base in the whole log",
            got=f"jumps of up to {np.abs(np.diff(q[:, 0]))[rows[changes]].max():.3g} rad",
            hint="import the parts between these rows separately, with start and stop under [time], and each "
            "with the robot file of its base",
        )


def _half_turns(R: Array) -> Array:
    """Return the angle (n,) [rad] between rotations (n, 3, 3) and the nearest multiple of half a turn."""
    angle = np.arccos(np.clip(0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0), -1.0, 1.0))
    return np.minimum(angle, np.pi - angle)


def _velocity_ratio(signals: Signals, rows: NDArray[np.int64], lag: int, moved: Array) -> float | None:
    """Return the ratio of ∫ q̇ dt to the displacement over `lag` rows, or `None` if they are uncorrelated."""
    qd, steps = signals.vectors["qd"], np.diff(signals.t)[:, None]
    integral = np.concatenate([np.zeros_like(qd[:1]), np.cumsum(0.5 * (qd[1:] + qd[:-1]) * steps, axis=0)])
    meant = integral[rows + lag] - integral[rows]
    power, expected, product = (moved**2).sum(0), (meant**2).sum(0), np.abs((moved * meant).sum(0))
    clear = product > CORRELATED * np.sqrt(power * expected)
    clear &= (power > 0.0) & (expected > 0.0)
    return float(np.median(np.sqrt(expected[clear] / power[clear]))) if clear.any() else None


def find_jumps(signals: Signals, report: ImportReport) -> None:
    """Find rows between which the position moves on by more than the velocity explains, since rows were lost,
    and jumps of the clock over which the position moves on by one usual step.

    With residuals r = Δq − q̇ Δt and noise σ per joint, a row is m = (r·q̇)/(q̇·q̇ Δt) steps late, weighted by
    1/σ². Without logged velocities, q̇ is the running median of Δq/Δt.
    """
    steps, moved = np.diff(signals.t), np.diff(signals.vectors["q"], axis=0)
    inner = np.diff(signals.segment) == 0
    wraps = any(finding.kind == "wrapped" for finding in report.findings)
    if inner.sum() < NEIGHBOURS or (moved[inner] == 0.0).all(axis=1).mean() > MOST_HELD:
        return
    step = float(np.median(steps[inner]))
    inner &= np.abs(steps - step) <= UNIFORM_TOLERANCE * step
    if wraps or not inner.any():
        return
    e, u = _residuals(moved, signals.vectors.get("qd"), step, inner)
    power, size = (u**2).sum(axis=1), (e**2).sum(axis=1)
    late = (e * u).sum(axis=1) / np.maximum(power, 1e-300)
    small = (late > LOST_STEP) & (size - late**2 * power < 0.25 * size) & (power > CLEAR**2)
    # A spike jumps back and a held value catches up; the positions after lost rows do not.
    stays = (e * uniform_filter1d(e, 7, axis=0) * 7.0).sum(axis=1) > 0.5 * size
    small &= stays
    if small.sum() < LOST_SHARE * (power > CLEAR**2).sum():
        small[:] = False
    usual = maximum_filter1d(power, NEIGHBOURS)  # an impact changes q̇ by at most twice its size
    large = (size > MANY_STEPS**2 * np.maximum(usual, CLEAR**2)) & stays
    clock = np.flatnonzero((steps > GAP_STEPS * step) & (size < 0.25 * power) & (power > CLEAR**2)) + 1
    if len(clock):
        text = f"the clock jumps by up to {steps[clock - 1].max():.3g} s in {len(clock)} rows"
        message = f"{text}, over which q moves on by one usual step: the stamps are wrong there"
        report.find("clock", message, signals.row[clock])
    jumps = np.flatnonzero(inner & (small | large)) + 1
    if len(jumps):
        text = f"q jumps by more than q̇ Δt explains, in {len(jumps)} rows"
        message = f"{text}: rows were lost, and the time stamps do not show it. Use the original stamps"
        report.find("lost", message, signals.row[jumps])


def _residuals(moved: Array, qd: Array | None, step: float, inner: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return Δq − q̇ Δt and q̇ Δt, both (n, nq) and in units of the noise of each joint."""
    meant = median_filter(moved, (NEIGHBOURS, 1))
    if qd is not None:
        logged = 0.5 * step * (qd[1:] + qd[:-1])
        meant = np.where(np.isnan(logged), meant, logged)
    residual = moved - meant
    residual -= median_filter(residual, (NEIGHBOURS, 1))  # such as the lag of a filtered velocity
    resolution = np.min(np.abs(moved), axis=0, where=moved != 0.0, initial=np.inf)
    noise = np.maximum(robust_std(residual[inner]), np.where(resolution < np.inf, 0.3 * resolution, 1.0))
    return residual / noise, meant / noise
