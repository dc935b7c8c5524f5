"""Steps of the state within one sample: positions that jump, and velocities that jump at an impact."""

from __future__ import annotations

import numpy as np

from forcegp.checks.clock import Outcome
from forcegp.checks.finding import Finding
from forcegp.checks.log import Log
from forcegp.checks.statistics import Array, any_row, describe, intervals
from forcegp.checks.values import resolution
from forcegp.constraints import ConstrainedSystem
from forcegp.robust import robust_std

JUMP = 30.0
"""Robust standard deviations beyond which a step is a jump, not noise: fifteen at each of two rows."""
FASTEST = 2.0
"""A jump also exceeds what the fastest joint changes within a step by this factor."""


def _surplus(x: Array, rate: Array, log: Log) -> Array:
    """`(n, nq)` change of x over each step beyond what its rate accounts for, at the row after the step."""
    surplus = np.zeros_like(x)
    for s in log.stretches:
        mean = 0.5 * (rate[s][1:] + rate[s][:-1])
        surplus[s][1:] = np.diff(x[s], axis=0) - mean * np.diff(log.t[s])[:, None]
    return surplus


def _jumps(x: Array, rate: Array, log: Log) -> np.ndarray:
    """`(n, nq)` bool, rows at which a column jumps."""
    surplus = _surplus(x, rate, log)
    usable = log.usable
    scale = (
        robust_std(surplus[usable]) + resolution(x[usable]) + np.finfo(float).eps * np.abs(x[usable]).max()
    )
    change = np.zeros_like(x)
    change[1:] = np.abs(np.diff(x, axis=0))
    fastest = float(np.percentile(np.abs(rate[usable]), 99.9)) * log.dt
    big = (np.abs(surplus) > JUMP * scale) & (np.abs(surplus) > FASTEST * fastest)
    # Where the column itself does not change faster than usual, its rate is at fault, not the position.
    return big & (change > JUMP * np.median(change[usable], axis=0)) & usable[:, None]


def check_jumps(system: ConstrainedSystem, log: Log) -> Outcome:
    """Positions that jump beyond what the velocity accounts for: rows are missing, or a joint wrapped."""
    if not log.stretches or "qd" in log.derived:
        return [], log
    jumps = _jumps(log.q, log.qd, log)
    if not jumps.any():
        return [], log
    rows = intervals(any_row(jumps))
    joints = tuple(log.joint_names[j] for j in np.flatnonzero(jumps.any(axis=0)))
    text = f"the position of {', '.join(joints)} jumps at {describe(rows)}"
    segment = log.segment + np.cumsum(any_row(jumps))
    return [Finding("position-jump", text, rows, joints)], log.replace(segment=segment)


def check_impacts(system: ConstrainedSystem, log: Log) -> Outcome:
    """Velocities that jump where the acceleration does not account for it: impacts."""
    if not log.stretches or log.derived:
        return [], log
    jumps = _jumps(log.qd, log.qdd, log)
    if not jumps.any():
        return [], log
    rows = intervals(any_row(jumps))
    joints = tuple(log.joint_names[j] for j in np.flatnonzero(jumps.any(axis=0)))
    text = f"the velocity jumps, as at an impact, at {describe(rows)}"
    around = any_row(jumps)
    around[:-1] |= around[1:]
    return [Finding("impact", text, rows, joints)], log.mask(around)
