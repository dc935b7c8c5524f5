"""What the motion lets one learn: joints that move, changes of direction, parameters that are identified."""

from __future__ import annotations

import numpy as np
import torch

from forcegp.checks.clock import Outcome
from forcegp.checks.finding import Finding
from forcegp.checks.hypotheses import MASS_SHARE, MOMENT_ARM
from forcegp.checks.log import Log
from forcegp.checks.residual import tensors
from forcegp.checks.statistics import Array
from forcegp.checks.units import position_unit
from forcegp.constraints import ConstrainedSystem
from forcegp.identification import base_parameters, regressor

STILL = 0.05
"""Range of motion below which a joint does not move [rad, m]."""
REVERSALS = 4
"""Changes of direction that tell Coulomb friction from an offset of the torque."""
HYSTERESIS = 0.05
"""Share of its largest speed that a joint must reach for a change of direction to count."""
SHORT_SECONDS = 2.0
"""Length of a log below which little is learned [s]."""
ROWS = 1000
"""Rows of which the regressor is made."""
LOOK = 0.1
"""Time after which the torque says something new [s]."""
LEARNED = 0.5
"""Standard deviation after the log, as a share of that before it, below which a parameter is identified."""


def check_length(system: ConstrainedSystem, log: Log) -> Outcome:
    """Logs too short for anything."""
    seconds = len(log.rows(len(log))) * log.dt if np.isfinite(log.dt) else 0.0
    if not log.header.ordered or seconds >= SHORT_SECONDS:
        return [], log
    text = f"{seconds:.3g} s of the log can be used"
    return [Finding("log-short", text, log.all_rows, evidence={"seconds": seconds})], log


def still_joints(log: Log) -> np.ndarray:
    """`(nq,)` bool, joints that stay within a hair of one position."""
    q = log.q[log.usable]
    return np.ptp(np.percentile(q, (0.5, 99.5), axis=0), axis=0) < STILL if len(q) else np.zeros(log.nq, bool)


def check_motion(system: ConstrainedSystem, log: Log) -> Outcome:
    """Joints that do not move, or hardly ever change direction."""
    still, found = still_joints(log), []
    if still.any():
        joints = tuple(log.joint_names[j] for j in np.flatnonzero(still))
        verb, whose = ("moves", "its") if len(joints) == 1 else ("move", "their")
        unit = " or ".join(dict.fromkeys(position_unit(system.robot, j) for j in np.flatnonzero(still)))
        least = f"{', '.join(joints)} {verb} by less than {STILL} {unit}"
        text = f"{least}: {whose} friction and inertia are not seen"
        found.append(Finding("joint-still", text, log.all_rows, joints))
    if not log.header.ordered:
        return found, log
    turns = np.zeros(log.nq, int)
    fast = HYSTERESIS * np.percentile(np.abs(log.qd[log.usable]), 99, axis=0)
    for s in log.stretches:
        for j in range(log.nq):
            x = log.qd[s][:, j]
            direction = np.sign(x[np.abs(x) > fast[j]])
            turns[j] += int((np.diff(direction) != 0).sum())
    few = (turns < REVERSALS) & ~still
    if few.any():
        joints = tuple(log.joint_names[j] for j in np.flatnonzero(few))
        why = "friction looks like an offset"
        verb = "changes" if len(joints) == 1 else "change"
        text = f"{', '.join(joints)} {verb} direction fewer than {REVERSALS} times: {why}"
        found.append(Finding("few-reversals", text, log.all_rows, joints))
    return found, log


def check_excitation(system: ConstrainedSystem, log: Log) -> Outcome:
    """Base parameters that the torque would not sharpen, and the motion that is missing for them."""
    rows = log.rows(ROWS)
    if len(rows) < 50 or still_joints(log).all():
        return [], log
    sharpness, names, columns = _sharpness(system, log, rows)
    weak = sharpness > LEARNED
    if not weak.any():
        return [], log
    joints = sorted({int(columns[k]) // 10 for k in np.flatnonzero(weak)})
    listed = ", ".join(names[k] for k in np.flatnonzero(weak)[:6])
    more = int(weak.sum()) - 6
    text = (
        f"{int(weak.sum())} of {len(weak)} base parameters are not identified: {listed}"
        + (f" and {more} more" if more > 0 else "")
        + f"; missing: {_missing(system, log, joints)}"
    )
    evidence = {"identified": int((~weak).sum()), "base_parameters": len(weak)}
    named = tuple(log.joint_names[j] for j in joints)
    return [Finding("poor-excitation", text, log.all_rows, named, evidence=evidence)], log


def _sharpness(system: ConstrainedSystem, log: Log, rows: np.ndarray) -> tuple[Array, tuple[str, ...], Array]:
    """Standard deviation of each base parameter after the log over that before it.

    Before: the robot file, with masses known to 30 % and centres of mass to 0.1 m. After: that and the
    torques of the rows, with noise of a hundredth of each joint's torque.
    """
    robot = system.robot
    base = base_parameters(robot)
    columns = np.array(base.columns)
    with torch.no_grad():
        Y = regressor(robot, *tensors(log, rows, "q", "qd", "qdd"))[..., list(base.columns)].numpy()
    tau = np.sqrt((log.tau[rows] ** 2).mean(axis=0))
    noise = np.maximum(0.01 * tau, 1e-3 * tau.max()) + 1e-12
    mass = np.maximum(robot.mass.numpy(), 0.01 * float(robot.mass.max()))
    share = np.array([MASS_SHARE, *[MOMENT_ARM] * 3, *[MOMENT_ARM**2] * 6])
    prior = (mass[:, None] * share).ravel()[columns]
    A = (Y / noise[:, None]).reshape(-1, len(columns)) * prior
    # Neighbouring rows tell the same: the log counts as one look per tenth of a second.
    looks = int(log.usable.sum()) * log.dt / LOOK if log.header.ordered else len(rows)
    gram = A.T @ A * (looks / len(rows))
    after = np.linalg.inv(gram + np.eye(len(columns)))
    return np.sqrt(np.diag(after)), base.names, columns


def _missing(system: ConstrainedSystem, log: Log, joints: list[int]) -> str:
    """The motion that would show the parameters of some links, in words."""
    q, qdd = log.q[log.usable], log.qdd[log.usable]
    reach, push = np.ptp(q, axis=0), np.sqrt((qdd**2).mean(axis=0))
    slow = [log.joint_names[j] for j in joints if push[j] < 1.0]
    narrow = [log.joint_names[j] for j in joints if reach[j] < 0.5]
    parts = [f"larger range of {', '.join(narrow[:3])}"] if narrow else []
    parts += [f"faster changes of speed of {', '.join(slow[:3])}"] if slow else []
    return "; ".join(parts) or "other poses of the whole arm, fast and slow"
