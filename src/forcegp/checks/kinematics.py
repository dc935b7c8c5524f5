"""Checks that qd is the derivative of q and that qdd is the derivative of qd.

The checks cover units, signs, order of columns, and noise. Changes of x over short windows are compared with
integrals of its logged rate. Noise flattens one of the two regression lines between them, so a rate is wrong
only if both slopes are. The noise in the acceleration should be white and as large as the header states. For
white noise, the deviations from cubics through neighbours one and three samples away have equal size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import correlate1d
from scipy.optimize import linear_sum_assignment

from forcegp import dynamics
from forcegp.checks.finding import Finding
from forcegp.checks.fit import cross_validate
from forcegp.checks.hypotheses import problem_of
from forcegp.checks.limits import DEGREE
from forcegp.checks.log import DEPARTURE, Array, Log, Outcome, derive
from forcegp.constraints import ConstrainedSystem
from forcegp.robust import robust_std

WINDOW = 0.05
"""Length of a window [s], long enough to average out noise and short compared with the motion."""
LEAST_WINDOWS = 40
"""Number of windows below which they are shortened. Half as many suffice for a comparison."""
TOLERANCE, INSTANT = 0.05, 0.15
"""Accepted deviations of a slope from 1: for filters, and for accelerations that change within a period."""
RELATED = 0.7
"""Correlation below which a velocity does not match its position, unless encoder steps are coarse."""
EXCHANGED, CLEARLY = 0.9, 5.0
"""Correlation with another joint's rate that indicates swapped columns; factor by which the swapped order
must reduce the unexplained variance."""
ALIKE_DELAY = 0.5
"""Relative difference up to which the delays of all joints are those of a common filter."""
PROPORTIONAL, HALF_STEP = 0.5, 0.75
"""Share of the missing motion that a delay must explain; smallest reported delay, in sampling periods."""
MOVES, TRIMMED, KEPT = 0.2, 10, 0.8
"""Change in a window, relative to its RMS, above which a joint moves; number of times that windows with
outliers are left out of the fit of a delay; share of the windows that are always kept."""
JUMPS = 0.05
"""Largest fraction of windows excluded because of impacts, at which velocity jumps without acceleration."""
INERTIA_ROWS = 200
"""Maximum number of rows at which inertias are computed."""
FRICTION_ROWS, LEAST_ROWS = 4000, 20
"""Maximum and minimum number of rows from which viscous friction is estimated."""


@dataclass(frozen=True)
class Match:
    """Changes of a column, and integrals of its rate, over windows (w, nq). Both are zero in windows with an
    impact, except in `whole`. `low` and `high` bound the slopes between them.
    """

    change: Array
    integral: Array
    whole: tuple[Array, Array]
    low: Array
    high: Array
    correlation: Array
    moving: np.ndarray

    def right(
        self, factor: float = 1.0, tolerance: float = TOLERANCE, least: Array | float = 1.0
    ) -> np.ndarray:
        """Return the mask `(nq,)` of joints whose slope can lie between `least` · `factor` and `factor`."""
        ratio = np.stack([self.low, self.high]) / factor
        return (ratio.min(axis=0) < 1.0 + tolerance) & (ratio.max(axis=0) > least * (1.0 - tolerance))


def match(log: Log, value: str, rate: str) -> Match | None:
    """Compare changes of a column with integrals of its rate; return `None` if there are too few windows."""
    x, v = getattr(log, value), getattr(log, rate)
    # With a wrong unit of time, a window of a fixed duration might be longer than the log.
    most = max(2, sum(s.stop - s.start for s in log.stretches) // LEAST_WINDOWS)
    width = min(max(2, round(WINDOW / log.dt)), most) if log.dt < WINDOW else 2
    changes, integrals = [], []
    for s in log.stretches:
        dt = np.diff(log.t[s])[:, None]
        total = np.concatenate([np.zeros((1, log.nq)), np.cumsum(0.5 * (v[s][1:] + v[s][:-1]) * dt, axis=0)])
        changes.append(np.diff(x[s][::width], axis=0))
        integrals.append(np.diff(total[::width], axis=0))
    if sum(map(len, changes)) < LEAST_WINDOWS // 2:
        return None
    whole = change, integral = np.concatenate(changes), np.concatenate(integrals)
    # Windows that an impact crosses, `JUMPS` of them at most, are left out.
    scale = np.sqrt((change**2).sum(axis=0) / np.maximum((integral**2).sum(axis=0), 1e-300))
    misfit = change - scale * integral
    outlier = np.abs(misfit) > 8.0 * robust_std(misfit) + 1e-12
    jumps = outlier & (np.abs(misfit) > np.quantile(np.abs(misfit), 1.0 - JUMPS, axis=0))
    change, integral = (np.where(jumps, 0.0, x) for x in whole)
    cross = (change * integral).sum(axis=0)
    integral_square, change_square = (integral**2).sum(axis=0), (change**2).sum(axis=0)
    low, high = cross / integral_square, change_square / cross
    correlation = cross / np.sqrt(integral_square * change_square)
    speed = np.sqrt(change_square)
    moving = speed > 1e-3 * speed.max()
    low, high, correlation = np.nan_to_num((low, high, correlation))
    return Match(change, integral, whole, low, high, correlation, moving)


def check_velocity(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find velocities that are not the derivative of the positions, or have a wrong unit, sign or order."""
    if "qd" in log.derived:
        return [], log
    level = match(log, "q", "qd")
    if level is None:
        return [], log
    wrong = level.moving & (~level.right() | (np.abs(level.correlation) < RELATED)) & ~_coarse(log, level)
    if not wrong.any():
        late = _late(log, level)
        # A filter of all velocities is in the torques as well, so that these stay in step.
        if late and not late[0].evidence["common"]:
            log = derive(log, ["qd", "qdd"] if "qdd" in log.derived | {*log.header.derived} else ["qd"])
        return late, log
    if "qd" in log.header.derived:
        return _mismatch("filter-wide", log, level, wrong, "qd", "q"), log
    if (permutation := _permutation(level)) is not None:
        rates, moved = match(log, "qd", "qdd"), permutation != np.arange(log.nq)
        text = "the velocities of {} belong to each other's positions"
        findings = log.on_joints("velocity-order", moved, text)
        follows = rates is not None and np.median(rates.correlation[moved]) > RELATED
        qdd = log.qdd[:, permutation] if follows else log.qdd  # where they had the order of the wrong ones
        return findings, log.replace(qd=log.qd[:, permutation], qdd=qdd)
    findings, factor = _velocity_findings(log, level, wrong)
    return findings, log.replace(qd=log.qd * factor)


def _late(log: Log, level: Match) -> list[Finding]:
    """Find velocities delayed by a filter. A delay L causes an error Δq − ∫q̇ dt = L Δq̇ in each window."""
    rates = match(log, "qd", "qdd")
    if rates is None or "qd" in log.header.derived:
        return []
    (change, integral), step = level.whole, rates.whole[0]
    pairs = [_delay(*columns) for columns in zip(change.T, (change - integral).T, step.T, strict=True)]
    delay, share = np.array(pairs).T
    # A velocity from neighbouring samples, or of a semi-implicit integrator, is half a step off by itself.
    late = level.moving & (share > PROPORTIONAL) & (np.abs(delay) > HALF_STEP * log.dt)
    each = [f"{1e3 * abs(x):.2g} ms {'behind' if x > 0 else 'ahead of'}" for x in delay[late]]
    shown = ", ".join(each if len(set(each)) > 1 else each[:1])
    text = f"{{}}: qd is {shown} the rate of change of q"
    common = (
        bool(late.any())
        and late[level.moving].all()
        and np.ptp(delay[late]) <= ALIKE_DELAY * delay[late].max()
    )
    return log.on_joints("velocity-delay", late, text, common=common)


def _delay(change: Array, misfit: Array, step: Array) -> tuple[float, float]:
    """Return the delay [s] of one joint, and the share of the misfit explained. Impacts are trimmed."""
    moves = np.abs(change) > MOVES * np.sqrt((change**2).mean())
    x, y, delay = step[moves], misfit[moves], 0.0
    keep, rest = np.ones(len(x), bool), np.zeros(len(x))
    if len(x) < LEAST_WINDOWS // 2:
        return 0.0, 0.0
    for _ in range(TRIMMED):
        delay = float(x[keep] @ y[keep] / max(x[keep] @ x[keep], 1e-300))
        rest = np.abs(y - delay * x)
        keep = rest <= max(4.0 * float(robust_std((y - delay * x)[keep])), float(np.quantile(rest, KEPT)))
    return delay, 1.0 - float((rest[keep] ** 2).sum() / max((y[keep] ** 2).sum(), 1e-300))


def _velocity_findings(log: Log, level: Match, wrong: np.ndarray) -> tuple[list[Finding], Array]:
    """Return one finding for each cause, and the factors that correct the velocities."""
    causes = ("velocity-sign", -1.0, "runs against"), ("degrees", 1.0 / DEGREE, "is 1/57 of")
    findings, factor, unexplained = [], np.ones(log.nq), wrong.copy()
    for kind, slope, what in (*causes, ("degrees", DEGREE, "is 57 times")):
        hit = unexplained & level.right(slope) & (np.abs(level.correlation) >= RELATED)
        if hit.any():
            text = f"qd of {{}} {what} the rate of change of q"
            findings += log.on_joints(kind, hit, text, slope=np.median(level.low[hit]))
            factor[hit], unexplained = slope, unexplained & ~hit
    return findings + _mismatch("velocity-mismatch", log, level, unexplained, "qd", "q"), factor


def _mismatch(kind: str, log: Log, level: Match, wrong: np.ndarray, rate: str, value: str) -> list[Finding]:
    """Report rates that are unrelated to their values, if any."""
    j = int(np.argmax(wrong))
    numbers = {"slope": level.low[j], "correlation": level.correlation[j]}
    shown = ", ".join(f"{name} {number:.3g}" for name, number in numbers.items())
    is_not = "was computed by a filter and has not" if kind == "filter-wide" else "is not"
    text = f"{rate} of {{}} {is_not} the rate of change of {value}: {shown}"
    return log.on_joints(kind, wrong, text, **numbers)


def _coarse(log: Log, level: Match) -> np.ndarray:
    """Return the joints that move only about one encoder step per window, too little to check their rates."""
    size = np.sqrt((level.change**2).mean(axis=0))
    moves = np.abs(np.diff(log.q, axis=0))
    steps = np.nanmedian(np.where(moves > 0.0, moves, np.nan), axis=0)
    return (size <= 3.0 * steps) & ((moves == 0.0).mean(axis=0) > 0.3)


def _permutation(level: Match) -> np.ndarray | None:
    """Return the order of rates that fits the changes of the joints better than the logged order, if any."""
    # Windows without impacts are those in which a joint fits its own rate, which here is the wrong one.
    change, integral = level.whole
    size = np.sqrt((change**2).sum(axis=0)), np.sqrt((integral**2).sum(axis=0))
    alike = np.nan_to_num(change.T @ integral / np.outer(*size))
    _, order = linear_sum_assignment(-alike)
    moved = (order != np.arange(len(order))) & level.moving
    if not moved.any():
        return None
    fits, unchanged = alike[np.arange(len(order)), order][moved], np.diag(alike)[moved]
    # Joints that move together are alike in any order; the right one leaves far less unexplained.
    better = (1.0 - unchanged**2) > CLEARLY * (1.0 - fits**2)
    return order if fits.min() >= EXCHANGED and better.all() else None


def _held_torque(system: ConstrainedSystem, log: Log) -> Array:
    """Return the mean acceleration `(nq,)` over a period of constant torque, relative to its initial value.

    Viscous friction d slows a joint with inertia m as exp(−d t/m), so the ratio is (1 − exp(−x))/x with x = d
    dt/m. After a change in torque, lightweight damped joints accelerate more than their velocity changes.
    """
    rows = log.rows(INERTIA_ROWS)
    (q,) = log.tensors(rows, "q")
    if not len(q):
        return np.ones(log.nq)
    with torch.no_grad():
        inverse = torch.linalg.inv(dynamics.mass_matrix(system.robot, q)).diagonal(dim1=-2, dim2=-1)
    damping, rows, nq = system.robot.damping.numpy(), log.rows(FRICTION_ROWS), log.nq
    if len(rows) >= LEAST_ROWS and log.tau[rows].any():
        problem = problem_of(system, log, rows)
        viscous, others = problem.nuisance[..., :nq], problem.nuisance[..., nq:]
        fit = cross_validate(replace(problem, nuisance=others), viscous)
        # Friction that the robot file lacks slows a joint as well.
        damping = damping - np.where(-fit.theta > CLEARLY * fit.spread, fit.theta, 0.0)
    x = np.maximum(damping * log.dt * inverse.median(dim=0).values.numpy(), 1e-6)
    return -np.expm1(-x) / x


def check_acceleration(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find accelerations that differ from the derivative of the velocities by more than the noise."""
    if log.derived:
        return [], log
    level = match(log, "qd", "qdd")
    if level is None:
        return [], log
    related = np.abs(level.correlation) > 0.3
    wrong = level.moving & related & ~level.right(tolerance=INSTANT, least=_held_torque(system, log))
    # An acceleration without relation to the motion is found if its integral is as large as the change.
    size = np.sqrt((level.integral**2).sum(axis=0) / np.maximum((level.change**2).sum(axis=0), 1e-300))
    wrong |= level.moving & ~related & ((size < 3.0) | (level.correlation < -0.3))
    if not wrong.any():
        return [], log
    kind = "filter-wide" if "qdd" in log.header.derived else "acceleration-mismatch"
    findings, qdd = _mismatch(kind, log, level, wrong, "qdd", "qd"), log.qdd.copy()
    for s in log.stretches:
        qdd[s, wrong] = np.gradient(log.qd[s][:, wrong], log.t[s], axis=0)
    return findings, log.replace(qdd=qdd, derived=log.derived | {"qdd"})


NOISE_FACTOR, FILTERED = 2.0, 0.4
"""Ratio of measured to stated noise above which the noise is reported; ratio of the noise at the highest
frequency to that at a third of it, below which the noise counts as filtered."""
NOISE_ROWS = 100


def noise_levels(log: Log) -> tuple[Array, Array] | None:
    """Return the standard deviations (nq,) of white noise estimated from neighbours at distances 1 and 3."""
    levels = []
    for k in (1, 3):  # neighbours at distance 3 reveal noise below the cut-off frequency of a filter
        weights = np.zeros(4 * k + 1)
        weights[::k] = DEPARTURE
        parts = (correlate1d(log.qdd[s], weights, axis=0)[2 * k : -2 * k] for s in log.stretches)
        rest = np.concatenate([np.empty((0, log.nq)), *parts])
        if len(rest) < NOISE_ROWS:
            return None
        levels.append(robust_std(rest) / np.linalg.norm(DEPARTURE))
    return levels[0], levels[1]


def check_noise(system: ConstrainedSystem, log: Log) -> Outcome:
    """Compare the noise in the logged acceleration with the noise stated in the header."""
    levels = noise_levels(log) if "qdd" not in log.derived else None
    if levels is None:
        return [], log
    top, middle = levels
    stated = log.header.noise_std
    filtered = top < FILTERED * middle
    evidence = {"white_noise_std": float(np.median(top)), "std_at_a_third": float(np.median(middle))}
    if stated is not None:
        evidence["stated_std"] = stated
        filtered &= top < stated / NOISE_FACTOR
    if filtered.mean() > 0.5 and not log.header.filtered:
        high = f"at the highest frequencies it holds {100 * np.median(top / middle):.2g} % of the noise"
        text = f"the acceleration is filtered: {high} that it holds at a third of them, so it is not white"
        # A filter contradicts only a header that states white noise, but a likelihood depends on it.
        weight = "note" if stated is None else "warning"
        finding = log.finding("noise-filtered", text, log.named(filtered), **evidence)
        return [replace(finding, weight=weight)], log
    if stated is None:
        return [], log
    kinds = [("noise-understated", top > NOISE_FACTOR * stated, np.max)]
    if not log.header.filtered:  # the highest frequencies show little of what a filter lets through
        kinds.append(("noise-overstated", top < stated / NOISE_FACTOR, np.min))
    findings = []
    for kind, wrong, worst in (one for one in kinds if one[1].any()):
        size = f"{worst(top[wrong]):.3g} rad/s²"
        text = f"the noise of qdd is {size} at {{}}, and the header states {stated:.3g}"
        findings += log.on_joints(kind, wrong, text, **evidence)
    return findings, log
