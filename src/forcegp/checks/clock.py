"""Checks of the clock: order, gaps, jitter, period, unit, and stamps or rows that the motion contradicts.

The motion is a second clock. Joint positions are smooth in time, so a position lies close to the line between
its neighbours if the stamps are right. If rows are missing, a position advances by an integer multiple of the
usual distance, whatever the stamps are.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from forcegp.checks.finding import Finding, at_rows
from forcegp.checks.kinematics import EXCHANGED, TOLERANCE, Match, match
from forcegp.checks.limits import DEGREE
from forcegp.checks.log import Array, Log, Outcome, computed, recomputed
from forcegp.constraints import ConstrainedSystem
from forcegp.data.derivative import UNIFORM_TOLERANCE
from forcegp.data.fields import resolution
from forcegp.robust import robust_std
from forcegp.rows import describe, intervals

ALIKE = 0.02
"""Tolerance within which all joints have the same slope, which indicates an incorrect clock rate."""
UNITS = (1e-9, 1e-6, 1e-3, 60.0, 1e3, 3600.0, 86400.0, 1e6, 1e9)
"""Units that a clock may have instead of seconds, or by which it was divided or multiplied [s]."""
UNIT_TOLERANCE = 0.1
DEGREES = (DEGREE, 1.0 / DEGREE)
"""Factors of a position or velocity in degrees, which are not the clock's."""
NEAR_WHOLE = 0.05
"""Relative distance from an integer within which the rate of a clock may be that of rows left out evenly."""
PERIODS, TYPICAL = (2e-5, 1.0), 4e-3
"""Plausible and typical sampling periods of a robot's log [s]."""
BURSTS, UNEVEN, FEWEST = 0.9, 0.5, 10
"""Share of the time that passes in the longer half of the steps if a clock comes in bursts; relative
difference of two steps that count as uneven; minimum number of such pairs."""
SMOOTHER = 0.5
"""Ratio of the deviations of positions from the line through their neighbours, without and with the stamps,
below which the stamps are wrong."""
NEIGHBOURS, NEAR, RESOLVED = 9, 0.25, 8.0
"""Number of rows whose median change is the usual one; distance from an integer that still counts as one;
size of a change in noise standard deviations that determines a multiple."""
JUDGED, REGULAR, SINGLE, LOST = 50, 0.8, 0.4, 0.005
"""Minimum number of rows with a determined multiple, share of multiples near an integer, share of single
steps around a lost row, and share of lost rows above which rows are reported as lost."""


def check_stamps(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find a clock that jumps or comes in bursts although the motion advances evenly from row to row."""
    steps = np.diff(log.t)
    forward = np.sort(steps[np.isfinite(steps) & (steps >= 0.0)])
    if len(forward) < FEWEST or not forward.any():
        return [], log
    share = float(forward[len(forward) // 2 :].sum() / forward.sum())
    if share < BURSTS or not _even_by_row(log, steps):
        return [], log
    period = _period(steps)
    half = "time stamps come in bursts, or stand still and jump: "
    text = f"{half}{100 * share:.3g} % of the time passes in half of the steps, but the motion takes "
    finding = log.finding("time-bursts", f"{text}{1e3 * period:.4g} ms per row throughout", period=period)
    return [finding], _numbered(log, steps, period)


def _period(steps: Array) -> float:
    """Return the mean step between the first and the last long one, without pauses [s]."""
    long = np.flatnonzero(steps > steps[steps >= 0.0].mean())
    between = steps[long[0] + 1 : long[-1] + 1]
    usual = (between >= 0.0) & (between <= 3.0 * np.median(steps[long]))
    return float(between[usual].mean()) if usual.any() else float(steps[steps >= 0.0].mean())


def _even_by_row(log: Log, steps: Array) -> bool:
    """Return whether positions are smoother by row number than by time stamp."""
    before, after = steps[:-1], steps[1:]
    finite = log.finite[:-2] & log.finite[1:-1] & log.finite[2:]
    changes = np.abs(np.diff(log.q, axis=0)).sum(axis=1)
    rows = finite & (before >= 0.0) & (after >= 0.0) & (np.abs(after - before) > UNEVEN * (after + before))
    rows = np.flatnonzero(rows & (changes[:-1] > 0.0) & (changes[1:] > 0.0))
    if len(rows) < FEWEST:
        return False
    first, middle, last = (log.q[rows + k] for k in range(3))
    weight = (before[rows] / (before[rows] + after[rows]))[:, None]
    by_clock = np.linalg.norm(middle - first - weight * (last - first), axis=1)
    by_row = np.linalg.norm(middle - 0.5 * (first + last), axis=1)
    fast = np.linalg.norm(last - first, axis=1)
    fast = fast >= np.median(fast)
    return bool(np.median(by_row[fast]) < SMOOTHER * np.median(by_clock[fast]))


def _numbered(log: Log, steps: Array, period: float) -> Log:
    """Return the log with evenly numbered rows, in segments that end where time or position jump back."""
    changes = np.abs(np.diff(log.q, axis=0)).max(axis=1)
    jumps = (np.diff(log.segment) != 0) & (changes > 10.0 * np.nanquantile(changes, 0.99))
    segment = np.append(0, np.cumsum((steps < 0.0) | jumps))
    header = log.header.model_copy(update={"dt": period})
    return recomputed(log.replace(t=period * np.arange(len(log)), segment=segment, header=header))


def check_order(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find time stamps that repeat or go backward within a segment."""
    repeated, backward = (np.append(False, wrong) for wrong in (log.steps == 0.0, log.steps < 0.0))
    findings = at_rows(repeated, "time-repeated", "time repeats in", steps=repeated.sum())
    findings += at_rows(backward, "time-backward", "time runs backward in", steps=backward.sum())
    return findings, log.mask(repeated | backward) if findings else log


def check_gaps(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find missing samples, indicated by time steps longer than clock jitter can explain."""
    gaps = log.steps > log.longest_step
    if log.masked is not None:
        # The step after a wrong time stamp is long because of that stamp.
        gaps &= ~log.masked[:-1]
    if not gaps.any():
        return [], log
    rows, longest = intervals(np.append(False, gaps)), float(np.nanmax(log.steps))
    missing = int(np.round(log.steps[gaps] / log.dt - 1.0).sum())
    gap = f"the longest gap takes {longest:.4g} s"
    text = f"about {missing} samples are missing before {describe(rows)}; {gap}"
    evidence = {"missing_samples": missing, "longest_s": longest, "period_s": log.dt}
    return [Finding("time-gap", text, rows, evidence=evidence)], log


def check_jitter(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find time steps that are too uneven for filters that assume even sampling."""
    regular = log.steps[(log.steps > 0.0) & (log.steps <= log.longest_step)]
    spread = float(robust_std(regular) / log.dt) if len(regular) > 1 else 0.0
    text = f"the time steps vary by {100 * spread:.2g} % around {log.dt:.4g} s"
    jitter = log.finding("time-jitter", text, relative_spread=spread, period_s=log.dt)
    return [jitter] if spread > UNIFORM_TOLERANCE else [], log


def check_period(system: ConstrainedSystem, log: Log) -> Outcome:
    """Compare the sampling period with the period stated in the header."""
    stated = log.header.dt
    if stated is None or not abs(log.dt / stated - 1.0) > UNIFORM_TOLERANCE:
        return [], log
    text = f"the header states a period of {stated:.4g} s, and the rows are {log.dt:.4g} s apart"
    return [log.finding("period-header", text, stated_s=stated, period_s=log.dt)], log


def check_lost(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find rows that are missing without a gap in the time stamps, so that positions advance by multiples."""
    multiple, judged = _multiples(log)
    if judged.sum() < JUDGED:
        return [], log
    whole = np.round(multiple)
    near = judged & (np.abs(multiple - whole) <= NEAR) & (whole >= 1.0)
    single = near & (whole == 1.0)
    # A joint that starts or bounces changes its speed for good, and passes through other multiples.
    lost = near & (whole >= 2.0) & np.append(False, near[:-1]) & np.append(near[1:], False)
    lost &= np.convolve(single, np.ones(NEIGHBOURS), "same") >= SINGLE * NEIGHBOURS
    regular = near.sum() >= REGULAR * judged.sum() and 2 * single.sum() > judged.sum()
    if not regular or lost.sum() < LOST * judged.sum() or lost.sum() < FEWEST:
        return [], log
    count, share = int((whole[lost] - 1.0).sum()), lost.sum() / judged.sum()
    text = f"at least {count} rows are missing that the time stamps do not show: the position advances by "
    text += f"twice the usual distance or more in {100 * share:.2g} % of the steps, before"
    return at_rows(lost, "rows-lost", text, missing_samples=count), log


def _multiples(log: Log) -> tuple[Array, np.ndarray]:
    """Return the change of positions relative to the usual one `(n,)`, and the rows that determine it."""
    multiple, judged = np.ones(len(log)), np.zeros(len(log), bool)
    for s in log.stretches:
        change, steps = np.diff(log.q[s], axis=0), np.diff(log.t[s])[:, None]
        # Not by q̇, which may have faults of its own.
        usual = median_filter(change / steps, (NEIGHBOURS, 1)) * steps
        noise = robust_std(change - usual) + resolution(log.q[s]) + 1e-12
        scaled = np.where(np.abs(usual) > RESOLVED * noise, usual / noise, 0.0)
        size = (scaled**2).sum(axis=1)
        rows = slice(s.start + 1, s.stop)
        # A lost row affects all joints alike.
        resolved = scaled != 0.0
        each = np.where(resolved, change / np.where(resolved, usual, 1.0), np.nan)
        agree = np.nanmax(each, axis=1) - np.nanmin(each, axis=1) <= 2.0 * NEAR * np.nanmax(each, axis=1)
        judged[rows] = agree & (resolved.sum(axis=1) >= min(2, log.nq))
        multiple[rows] = (scaled * change / noise).sum(axis=1) / np.where(size > 0.0, size, np.inf)
    return multiple, judged


def check_clock_unit(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find a factor common to all joints and both derivatives, which indicates an incorrect clock rate."""
    if not log.stretches:
        return [], log
    if "qd" in computed(log):
        return _implausible_period(log)
    first = match(log, "q", "qd")
    if first is None or not first.moving.any():
        return [], log
    factor = float(np.median(first.low[first.moving]))
    if log.derived or "qdd" in log.header.derived:
        is_common = _unit(factor) is not None or _one_factor(first, factor)
        return _clock_finding(log, factor) if is_common else ([], log)
    second = match(log, "qd", "qdd")
    if second is None or not (both := first.moving & second.moving).any():
        return [], log
    off = factor > 0.0 and abs(factor - 1.0) > TOLERANCE and first.right(factor)[first.moving].all()
    # The velocity alone being off leaves the acceleration its derivative.
    off = off and second.right()[both].mean() <= 0.5 <= second.right(factor)[both].mean()
    return _clock_finding(log, factor) if off else ([], log)


def _implausible_period(log: Log) -> Outcome:
    """Judge the unit by the sampling period alone, since velocities were computed with the same clock."""
    if PERIODS[0] <= log.dt < PERIODS[1]:
        return [], log
    unit = min(UNITS, key=lambda unit: abs(np.log(unit * log.dt / TYPICAL)))
    text = f"rows are {log.dt:.4g} apart, which in seconds is an implausible sampling period of a robot's log"
    findings = [log.finding("time-unit", text, seconds_per_unit=unit, period=log.dt)]
    return findings, recomputed(log.replace(t=unit * log.t))


def _unit(factor: float) -> float | None:
    """Return the unit of time that explains a factor, or `None`. Minutes are 60, and degrees 57.3."""
    if factor <= 0.0:
        return None
    unit = min((*UNITS, *DEGREES), key=lambda unit: abs(np.log(factor / unit)))
    return unit if unit in UNITS and abs(factor / unit - 1.0) <= UNIT_TOLERANCE else None


def _clock_finding(log: Log, factor: float) -> Outcome:
    if (unit := _unit(factor)) is not None:
        kind, scale = "time-unit", unit
        text = f"time advances by {log.dt:.4g} per row, and by the motion {factor * log.dt:.4g} s"
    else:
        kind, scale = "time-scale", factor
        text = f"positions and velocities change {factor:.4g} times as far as the clock allows"
        if (kept := round(factor)) > 1 and abs(factor - kept) <= NEAR_WHOLE * kept:
            text += f"; or the log has only one of {kept} rows, evenly, with the stamps of all of them"
    finding = log.finding(kind, text, seconds_per_unit=factor, period=log.dt)
    log = log.replace(t=log.t * scale)
    second = match(log, "qd", "qdd")
    if "qdd" in log.derived | {*log.header.derived} and second is not None and second.moving.any():
        slope = max(float(np.median(second.low[second.moving])), 1e-300)
        if abs(np.log(slope * scale)) < abs(np.log(slope)):  # derived by the wrong clock
            log = log.replace(qdd=log.qdd / scale)
    return [finding], log


def _one_factor(level: Match, factor: float) -> bool:
    """Return whether several joints share a slope that is wrong and that degrees do not explain."""
    degrees = any(abs(np.log(abs(factor) * unit)) <= UNIT_TOLERANCE for unit in DEGREES)
    if factor <= 0.0 or abs(factor - 1.0) <= TOLERANCE or degrees or level.moving.sum() < 2:
        return False
    related = np.abs(level.correlation[level.moving]) >= EXCHANGED
    return bool(related.all() and level.right(factor, ALIKE)[level.moving].all())
