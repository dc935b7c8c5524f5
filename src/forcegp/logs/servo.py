"""Torques of servos, which follow from commanded positions (`[servo]` in a mapping).

A servo with stiffness k_p and damping k_d drives its joint with τ = k_p (q_c(t − s) − q) − k_d q̇, where the
command q_c is late by s. The stiffness is a nominal one: a fit learns its relative error, which is determined
as far as the links in the robot file resist the motion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from forcegp.errors import DataError
from forcegp.logs.compensated import subtracted
from forcegp.logs.mapping import Mapping
from forcegp.logs.smoothing import add_derivatives
from forcegp.logs.table import Array, ImportReport, Signals
from forcegp.robot import RobotModel

LONGEST, STEP, ROWS = 0.1, 0.002, 20_000
"""Longest delay to try and step of the first search [s], and maximum number of rows used. Delays of 10 ms are
found within 1 ms for an iiwa 14 and an SO-101 in MuJoCo, at 50 and 500 Hz."""
RISE, RIDGE = 0.01, 1e-9
"""Speed over which dry friction rises in this search [rad/s, m/s], and its ridge relative to each column."""
MOVING = 0.7
"""Share of the RMS speed above which a joint moves: near reversals, filters blur dry friction. Without this
bound, delays of 10 ms are found as 10.4 to 14.5 ms; with .3, 9.9 to 12.3; with 1, 9.9 to 10.4."""
COLUMNS = 5
"""Number of unknowns of each joint in this search."""
AT_LIMIT = 0.999
"""Share of the torque limit above which a servo saturates."""


def spring_torque(signals: Signals, robot: RobotModel, mapping: Mapping, report: ImportReport) -> None:
    """Replace the vector `command` by the torque k_p (q_c(t − s) − q), and add the command itself, late by s.

    Rows whose command was given before the log are dropped.

    Raises:
        DataError: no row is left.
    """
    section = mapping.sections.servo
    if section is None:
        return
    joints = signals.joint_names
    stiffness = mapping.per_joint("servo", "stiffness", joints)
    delay = _delay(signals, robot, mapping) if section.delay == "auto" else float(section.delay)
    late = _shifted(signals, delay)
    known = np.asarray(np.isfinite(late).all(axis=1))
    signals.vectors["command"] = late
    if not known.any():
        raise DataError(
            "the log is shorter than the delay of its commands",
            expected=f"more than {delay:.3g} s",
            got=f"{np.ptp(signals.t):.3g} s",
        )
    signals.keep(known)
    signals.vectors["tau"] = stiffness * (signals.vectors["command"] - signals.vectors["q"])
    how = "found from the motion" if section.delay == "auto" else "given"
    report.steps.append(
        f"computed torques from commands {1e3 * delay:.1f} ms earlier ({how}) and nominal stiffness"
    )


def damp(signals: Signals, std: Array | None, mapping: Mapping, report: ImportReport) -> Array | None:
    """Add the torque −k_d q̇, drop rows in which a servo saturates, and return σ of q̈ in the other rows."""
    section = mapping.sections.servo
    if section is None:
        return std
    joints = signals.joint_names
    damping = mapping.per_joint("servo", "damping", joints)
    signals.vectors["tau"] = signals.vectors["tau"] - damping * signals.vectors["qd"]
    if section.limit is None:
        return std
    limit = mapping.per_joint("servo", "limit", joints)
    over = np.abs(signals.vectors["tau"]) >= AT_LIMIT * limit
    hit = np.asarray(over.any(axis=1))
    if not hit.any():
        return std
    if hit.all():
        raise DataError(
            "a servo saturates in every row", expected="torques below the limit", got=limit.tolist()
        )
    names = ", ".join(np.array(joints)[over.any(axis=0)])
    report.find("clipped", f"the servo of {names} saturates: {hit.sum()} rows were dropped", signals.row[hit])
    signals.keep(~hit, split=True)
    return None if std is None else std[~hit]


def servo_fields(mapping: Mapping, joints: tuple[str, ...]) -> dict[str, Any]:
    """Return the fields of a data set's header that describe the servos."""
    section = mapping.sections.servo
    assert section is not None
    return {
        "torque_scale_std": section.stiffness_std or None,
        "servo_stiffness": tuple(mapping.per_joint("servo", "stiffness", joints).tolist()),
        "servo_damping": tuple(mapping.per_joint("servo", "damping", joints).tolist()),
    }


def _shifted(signals: Signals, delay: float) -> Array:
    """Return the commands `delay` earlier (n, nq), NaN before the first one of a trajectory.

    Linear interpolation of a log at 50 Hz is off by as much as a stiff servo, so that delays are multiples of
    the sampling period.
    """
    late = np.full_like(signals.vectors["command"], np.nan)
    for rows in signals.runs():
        t, command = signals.t[rows], signals.vectors["command"][rows]
        if len(t) > 1:
            late[rows] = PchipInterpolator(t, command, extrapolate=False)(t - delay)
    return late


def _delay(signals: Signals, robot: RobotModel, mapping: Mapping) -> float:
    """Return the delay [s] for which the error of the command is best explained.

    q_c(t − s) − q = (M q̈ − Q_C − Q_G + a q̈ + d q̇ + f sgn q̇ + o)/k_p is linear in the unknowns for a given s,
    which all joints share.
    """

    def filtered(name: str) -> Signals:
        """Return signals with derivatives, whose torque is the given vector after the same filter."""
        copies = {key: x.copy() for key, x in signals.vectors.items()}
        trial = replace(signals, vectors=copies | {"tau": copies[name]})
        add_derivatives(trial, mapping.sections.derivatives, ImportReport(""))
        return trial

    trial = filtered("command")
    trial.vectors["command"] = trial.vectors["tau"]
    smooth = filtered("q").vectors["tau"]
    # The same rows for every delay, without those at which the filter or the commands begin or end
    usable = np.asarray(np.isfinite(_shifted(trial, LONGEST)).all(axis=1))
    edge = mapping.sections.derivatives.window
    for run in trial.runs():
        usable[run][:edge] = usable[run][-edge:] = False
    inner = np.flatnonzero(usable)
    if len(inner) <= COLUMNS:
        raise DataError(
            "the log is too short to find the delay of its commands",
            expected="trajectories of a second or more",
            got=f"{np.ptp(signals.t):.3g} s in {len(trial.runs())} trajectories",
            hint="state it, as in delay = 0.01 under [servo]",
        )
    rows = inner[np.unique(np.linspace(0, len(inner) - 1, min(len(inner), ROWS)).round().astype(int))]
    q, qd, qdd = (trial.vectors[name][rows] for name in ("q", "qd", "qdd"))
    rigid = subtracted(robot, "model", q, qd, qdd)
    columns = np.stack([rigid, qdd, qd, np.tanh(qd / RISE), np.ones_like(q)], axis=-1)
    columns = columns / np.sqrt(np.square(columns).mean(axis=0) + 1e-300)

    moving = np.abs(qd) > MOVING * np.sqrt(np.square(qd).mean(axis=0))

    def left(delay: float) -> float:
        """Return the sum of the log RMS of what is left, over the joints."""
        ahead = _shifted(trial, delay)[rows] - smooth[rows]
        return sum(
            _log_rms(columns[own, j], ahead[own, j]) for j, own in enumerate(moving.T) if own.sum() > COLUMNS
        )

    tried = np.arange(0.0, LONGEST, STEP)
    best = tried[int(np.argmin([left(s) for s in tried]))]
    bounds = (max(0.0, best - 2.0 * STEP), best + 2.0 * STEP)
    return float(scipy.optimize.minimize_scalar(left, bounds=bounds, method="bounded").x)


def _log_rms(X: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Return the log RMS of what least squares leaves of y."""
    gram = X.T @ X + RIDGE * len(X) * np.eye(X.shape[1])
    rest = y - X @ np.linalg.solve(gram, X.T @ y)
    return 0.5 * float(np.log(np.square(rest).mean() + 1e-300))
