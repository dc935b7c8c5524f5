"""Checks for values beyond the limits in the robot file, clipped torques, and angles in degrees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forcegp.checks.finding import at_rows
from forcegp.checks.fit import cross_validate
from forcegp.checks.hypotheses import gain_hypothesis, problem_of
from forcegp.checks.log import Array, Log, Outcome, log_of
from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.data.clipped import clipped

DEGREE = np.pi / 180.0
TURN = 2.0 * np.pi
SLACK = 1e-3
"""Fraction of the range by which a value may exceed a limit due to rounding or encoder errors at a stop."""
OFTEN, UNIT_ROWS = 0.05, 400
"""Fraction of rows beyond the limits that suggests a wrong unit; number of rows for comparing torques."""


def _limits(system: ConstrainedSystem) -> dict[str, tuple[Array, Array]]:
    """Return the lower and upper limits of each column."""
    r = system.robot
    low, high, speed, effort = (x.numpy() for x in (r.lower, r.upper, r.velocity_limit, r.effort_limit))
    return {"q": (low, high), "qd": (-speed, speed), "tau": (-effort, effort)}


def check_degrees(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find angles in degrees, which exceed the joint ranges but match ranges and torques if converted."""
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
    radians = log.replace(**{name: getattr(log, name) * factor for name in _angles(log)})
    if _misfit(system, radians) > _misfit(system, log):
        return [], log
    beyond = f"beyond the joint limits in {100 * outside:.0f} % of the rows"
    text = f"angles reach {largest:.4g}, {beyond}: degrees"
    return [log.finding("degrees", text, log.named(turning), largest=largest)], radians


def _misfit(system: ConstrainedSystem, log: Log) -> float:
    """Return the held-out torque error with a free gain per joint, or 0 if the torque is uninformative."""
    rows = log.rows(UNIT_ROWS)
    if len(rows) < UNIT_ROWS or not log.tau[rows].any():
        return 0.0
    gains = gain_hypothesis(log, rows, tuple(range(log.nq)))
    fit = cross_validate(problem_of(system, log, rows), gains.columns, gains.prior, gains.joints)
    return float(fit.score.mean())


def _angles(log: Log) -> list[str]:
    """Return the columns that are in degrees if angles are. Derivatives are included unless in radians."""
    columns = ["q"]
    for name, source in (("qd", "q"), ("qdd", "qd")):
        step = sum(np.abs(np.diff(getattr(log, source)[s], axis=0)).sum() for s in log.stretches)
        path = sum(np.abs(getattr(log, name)[s]).sum() * log.dt for s in log.stretches)
        columns += [name] if source in columns and path > 0.1 * step else []
    return columns


def check_limits(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find positions, velocities and torques beyond the limits in the robot file."""
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
    """Find torques that stay at their largest value for several rows because the amplifier clips them."""
    mask = clipped_torques(log)
    joints = log.named(mask.any(axis=0))
    text = f"the torque of {', '.join(joints)} stays at its largest value in"
    return at_rows(np.asarray(mask.any(axis=1)), "torque-saturated", text, joints), log


def clipped_torques(data: Dataset | Log) -> NDArray[np.bool_]:
    """Return a mask (n, nq) of torques that stay at the largest or smallest value of their joint.

    Use the unfiltered log, since filters smooth the plateaus. `forcegp import` drops these rows, or states
    their noise in `extras["tau_std"]`.

    Args:
        data: a log in time order.

    Example:
        `train = log[torch.from_numpy(~clipped_torques(log).any(-1))]`
    """
    log = data if isinstance(data, Log) else log_of(data)
    return clipped(log.tau, log.qd, log.usable)
