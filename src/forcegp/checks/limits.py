"""Values beyond the limits of the robot file, torques that clip, and degrees that look like radians."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forcegp.checks.finding import at_rows
from forcegp.checks.fit import cross_validate
from forcegp.checks.hypotheses import gain_hypothesis, problem_of
from forcegp.checks.log import Array, Log, Outcome, log_of
from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.rows import Intervals, intervals

DEGREE = np.pi / 180.0
TURN = 2.0 * np.pi
SLACK = 1e-3
"""Share of a limit by which it may be exceeded: rounding, and encoders that read a little beyond a stop."""
CLIPPED_RUN, OFTENER = 3, 5.0
"""Successive rows at an extreme value that make a plateau; factor by which a clipped value occurs more
often than its neighbours; at the peaks of a sine, 2.4."""
BAND = 0.03
"""Part of the range of a torque that noise of a clipped one stays within."""
PLATEAUS, FLAT_ROWS, FLAT = 3, 10, 0.35
"""Least plateaus of a noisy clipped torque while its joint moves, rows of each, and variance of steps over
twice that of the values in their middle halves: 1 for white noise about a limit, 0.43 for the current of a
real drive, 0.05 to 0.3 at smooth peaks."""
MOVES = 0.02
"""Part of its largest speed from which a joint moves; the torque of one that rests is constant."""
OFTEN, UNIT_ROWS = 0.05, 400
"""Share of rows beyond the limits that suggests a wrong unit, and number of rows for comparing torques."""


def _limits(system: ConstrainedSystem) -> dict[str, tuple[Array, Array]]:
    """Return the lower and upper limits by column."""
    r = system.robot
    low, high, speed, effort = (x.numpy() for x in (r.lower, r.upper, r.velocity_limit, r.effort_limit))
    return {"q": (low, high), "qd": (-speed, speed), "tau": (-effort, effort)}


def check_degrees(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find angles in degrees, which exceed the joint's range and fit range and torque once converted."""
    low, high = _limits(system)["q"]
    turning = system.robot.revolute.cpu().numpy() > 0.0
    low, high = np.where(np.isfinite(low), low, -TURN), np.where(np.isfinite(high), high, TURN)
    q = log.q[log.usable]
    if not len(q) or not turning.any():
        return [], log
    outside = ((q < low) | (q > high))[:, turning].any(axis=1).mean()
    scaled = q * DEGREE
    still = ((scaled < low - 0.1) | (scaled > high + 0.1))[:, turning].any(axis=1).mean()
    largest = float(np.abs(q[:, turning]).max())
    if outside < OFTEN or still > 0.0 or largest < TURN:
        return [], log
    factor = np.where(turning, DEGREE, 1.0)
    # Velocities follow the angles where they are their derivative; the check of units comes after.
    radians = log.replace(**{name: getattr(log, name) * factor for name in _angles(log, turning)})
    if _misfit(system, radians) > _misfit(system, log):
        return [], log
    beyond = f"beyond the joint limits in {100 * outside:.0f} % of the rows"
    text = f"angles reach {largest:.4g}, {beyond}: degrees"
    return [log.finding("degrees", text, log.named(turning), largest=largest)], radians


def _misfit(system: ConstrainedSystem, log: Log) -> float:
    """Return the held-out error of the torque up to a gain per joint; 0 if no torque is informative."""
    rows = log.rows(UNIT_ROWS)
    if len(rows) < UNIT_ROWS or not log.tau[rows].any():
        return 0.0
    gains = gain_hypothesis(log, rows, tuple(range(log.nq)))
    fit = cross_validate(problem_of(system, log, rows), gains.columns, gains.prior, gains.joints)
    return float(fit.score.mean())


def _angles(log: Log, turning: np.ndarray) -> list[str]:
    """Return the columns in degrees where angles are: velocities that are the derivative of the angles."""
    columns = ["q"]
    for name, source in (("qd", "q"), ("qdd", "qd")):
        step = [np.abs(np.diff(getattr(log, source)[s], axis=0)).sum() for s in log.stretches]
        path = [np.abs(getattr(log, name)[s]).sum() * log.dt for s in log.stretches]
        if source in columns and sum(path) > 0.1 * sum(step):
            columns.append(name)
    return columns


def check_limits(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find positions, velocities and torques beyond the limits of the robot file."""
    kinds = {"q": "position-limit", "qd": "velocity-limit", "tau": "torque-limit"}
    findings = []
    for name, (low, high) in _limits(system).items():
        value = getattr(log, name)
        slack = SLACK * np.where(np.isfinite(high - low), high - low, 0.0)
        with np.errstate(invalid="ignore"):
            beyond = ((value < low - slack) | (value > high + slack)) & log.usable[:, None]
        hit, joints = beyond.any(axis=1), log.named(beyond.any(axis=0))
        text = f"{name} of {', '.join(joints)} exceeds the limit of the robot file in"
        findings += at_rows(hit, kinds[name], text, joints, rows=hit.sum())
    return findings, log


def check_saturation(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find torques that stay at their largest value for several rows: the amplifier clips."""
    clipped = clipped_torques(log)
    joints = log.named(clipped.any(axis=0))
    text = f"the torque of {', '.join(joints)} stays at its largest value in"
    return at_rows(np.asarray(clipped.any(axis=1)), "torque-saturated", text, joints), log


def clipped_torques(data: Dataset | Log) -> NDArray[np.bool_]:
    """Return the mask `(n, nq)` of torques that stay at the largest or smallest value of their joint.

    Use the unfiltered log, since filters smooth the plateaus. Exclude these rows from training data,
    or state their noise in `extras["tau_std"]` for an external wrench.

    Args:
        data: a log in order of time.

    Example:
        `train = log[torch.from_numpy(~clipped_torques(log).any(-1))]`
    """
    log = data if isinstance(data, Log) else log_of(data)
    clipped = np.zeros(log.tau.shape, bool)
    for j in range(log.nq):
        tau = log.tau[:, j]
        usable = tau[log.usable]
        if not len(usable) or np.ptp(usable) == 0.0:
            continue
        for extreme in limits_of(usable):
            for first, last in _plateaus(log, j, extreme):
                clipped[first:last, j] = True
    return clipped


def limits_of(values: Array) -> tuple[float, float]:
    """Return the most frequent values near the maximum and minimum, since a filter overshoots a limit."""
    limits = []
    for extreme in (values.max(), values.min()):
        near, counts = np.unique(
            values[np.abs(values - extreme) <= BAND * np.ptp(values)], return_counts=True
        )
        often = near[counts == counts.max()]
        limits.append(float(often[np.abs(often - extreme).argmin()]))
    return limits[0], limits[1]


def _plateaus(log: Log, j: int, extreme: float) -> Intervals:
    """Return the runs of rows in which a torque is clipped at an extreme value, up to noise."""
    tau, moves = log.tau[:, j], np.abs(log.qd[:, j]) > MOVES * np.abs(log.qd[log.usable, j]).max()
    usable, width = tau[log.usable], BAND * np.ptp(tau[log.usable])
    if extreme == 0.0:
        return ()
    # A value that the column reaches far more often than its neighbourhood is a limit.
    at = (tau == extreme) & log.usable
    near = np.abs(usable - extreme) <= width
    runs = tuple((a, b) for a, b in intervals(at) if b - a >= CLIPPED_RUN)
    others = (near.sum() - at.sum()) / max(len(np.unique(usable[near])) - 1, 1)
    if runs and at.sum() > OFTENER * max(others, 1.0):
        return runs
    # With noise, a band of values, beside the next one of the same width.
    band = (np.abs(tau - extreme) <= width) & log.usable & moves
    beside = (np.abs(tau - extreme) > width) & (np.abs(tau - extreme) <= 2.0 * width) & log.usable & moves
    runs = tuple((a, b) for a, b in intervals(band) if b - a >= FLAT_ROWS)
    if len(runs) < PLATEAUS or band.sum() <= OFTENER * max(beside.sum(), 1):
        return ()
    middles = [tau[(3 * a + b) // 4 : (a + 3 * b + 3) // 4] for a, b in runs]
    steps = sum(float((np.diff(x) ** 2).sum()) for x in middles)
    return runs if steps > 2.0 * FLAT * sum(len(x) * float(x.var()) for x in middles) else ()
