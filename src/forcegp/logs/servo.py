"""Torques of servos, which follow from commanded positions (`[servo]` in a mapping).

A servo with stiffness k_p and damping k_d drives its joint with τ = k_p (q_c(t − s) − q) − k_d q̇, where the
command q_c is late by s. Commanded velocities and torques are part of it,

    τ = k_p (q_c − q) + k_d (q̇_c − q̇) + τ_c = k_p (q_c + (k_d q̇_c + τ_c)/k_p − q) − k_d q̇.

The stiffness is a nominal one: a fit learns its relative error, which is determined as far as the links in
the robot file resist the motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

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
"""Longest delay to try and step of the first search [s], and maximum number of rows used."""
EARLIER = (0.02, 0.07)
"""Times by which commands precede the motion that they are instruments for [s]."""
RISE, RANK, FEWEST = 0.01, 1e-9, 50
"""Speed over which dry friction rises in this search [rad/s, m/s], relative singular value of dependent
columns, and fewest rows of a joint."""
MOVING = 0.7
"""Share of the RMS speed above which a joint moves: near reversals, filters blur dry friction. In MuJoCo,
with an SO-101 and an iiwa 14 at 50 and 500 Hz, delays of 10 ms are found as 9.6 to 11.0 ms with noise of
0.01 to 0.4 mrad of positions; of all rows, as 10.6 to 11.9. By least squares without instruments, noise of
0.4 mrad yields 26 ms."""
HOLD, HELD = 0.2, 0.1
"""Time within which the next change of a command belongs to the same motion [s], and share of changes after
which the command is held. In MuJoCo, steps of 20 and 32 ms in logs at 250 Hz yield 84 ms and more for a delay
of 12 ms; logs at the rate of the steps yield 21 and 25 ms, which contain half a step."""
COLLINEAR, CLEAR = 1e-3, 30.0
"""Share of the force of links that no other column explains, and multiple of a standard deviation that
ignores correlation of residuals, above which a stiffness is found. Of 104 joints (an SO-101 and an iiwa 14 in
MuJoCo, 50 and 500 Hz, noise of 0.01 and 0.4 mrad), errors of those above it are at most 11 %, median 0.4 %.
Of those below, they are up to a wrong sign: the last joint of the iiwa carries hardly any inertia."""
AT_LIMIT = 0.999
"""Share of the torque limit above which a servo saturates."""


def spring_torque(signals: Signals, robot: RobotModel, mapping: Mapping, report: ImportReport) -> Mapping:
    """Compute the torques k_p (q_c(t − s) − q), and shift the vector `command` by the delay s.

    Rows whose command was given before the log begins are dropped.

    Returns:
        The mapping, with each stiffness that was found from the motion.

    Raises:
        DataError: no row is left, or the motion does not determine a delay or a stiffness.
    """
    section = mapping.sections.servo
    if section is None:
        return mapping
    joints = signals.joint_names
    stiffness, damping = (mapping.per_joint("servo", key, joints) for key in ("stiffness", "damping"))
    for name, gain in (("command_velocity", damping), ("command_torque", 1.0)):
        if (more := signals.vectors.pop(name, None)) is not None:
            signals.vectors["command"] = signals.vectors["command"] + gain * more / stiffness
            report.steps.append(f"added {name.replace('command_', 'commanded ')} to the commands")
    late = section.delay == "auto"
    if late and _is_held(signals):
        raise DataError(
            "the delay of the commands cannot be found, since commands are held over several rows",
            expected="commands that change in every row in which the arm is told to move",
            got="commands that move in steps",
            hint="state it, as in delay = 0.01 under [servo], or log at the rate of the commands",
        )
    unknown = np.isnan(stiffness)
    search = _Search.of(signals, robot, mapping) if late or unknown.any() else None
    delay = search.delay() if search is not None and late else float(section.delay)
    if search is not None and unknown.any():
        stiffness = np.where(unknown, search.stiffness(delay, unknown), stiffness)
        stiffnesses = {name: float(f"{k:.4g}") for name, k in zip(joints, stiffness, strict=True)}
        servo = section.model_copy(update={"stiffness": stiffnesses})
        mapping = replace(mapping, sections=mapping.sections.model_copy(update={"servo": servo}))
        stiffness = mapping.per_joint("servo", "stiffness", joints)
        shown = ", ".join(f"{name} {stiffnesses[name]:g}" for name in np.array(joints)[unknown])
        report.steps.append(f"found the stiffness from the motion and the masses of the robot file: {shown}")
    late_command = _shifted(signals, signals.vectors["command"], delay)
    known = np.asarray(np.isfinite(late_command).all(axis=1))
    signals.vectors["command"] = late_command
    if not known.any():
        raise DataError(
            "the log is shorter than the delay of its commands",
            expected=f"more than {delay:.3g} s",
            got=f"{np.ptp(signals.t):.3g} s",
        )
    signals.keep(known)
    signals.vectors["tau"] = stiffness * (signals.vectors["command"] - signals.vectors["q"])
    how = "found from the motion" if late else "given"
    report.steps.append(
        f"computed torques from commands {1e3 * delay:.1f} ms earlier ({how}) and nominal stiffness"
    )
    return mapping


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
        "servo_stiffness": tuple(mapping.per_joint("servo", "stiffness", joints).tolist()),
        "servo_damping": tuple(mapping.per_joint("servo", "damping", joints).tolist()),
    }


def _shifted(signals: Signals, x: Array, delay: float) -> Array:
    """Return vectors x (n, k) at times `delay` earlier, NaN before the first one of a trajectory.

    At 50 Hz, errors of linear interpolation are as large as those of a stiff servo, and the search would find
    multiples of the sampling period.
    """
    late = np.full_like(x, np.nan)
    for rows in signals.runs():
        if len(t := signals.t[rows]) > 1:
            late[rows] = PchipInterpolator(t, x[rows], extrapolate=False)(t - delay)
    return late


class _Motion(NamedTuple):
    """Signals with positions and velocities (n, nq) after a filter, and columns (n, nq, 5)."""

    signals: Signals
    q: Array
    qd: Array
    columns: Array


def _motion(signals: Signals, robot: RobotModel, mapping: Mapping, name: str) -> _Motion:
    """Return the measured (`q`) or the commanded motion (`command`), with the columns of `_delay`."""
    x = signals.vectors[name]
    trial = replace(signals, vectors={"q": x.copy(), "tau": x.copy()}, contact={})
    add_derivatives(trial, mapping.sections.derivatives, ImportReport(""))
    q, qd, qdd = (trial.vectors[key] for key in ("q", "qd", "qdd"))
    columns = (subtracted(robot, "model", q, qd, qdd), qdd, qd, np.tanh(qd / RISE), np.ones_like(q))
    return _Motion(trial, trial.vectors["tau"], qd, np.stack(columns, axis=-1))


@dataclass(frozen=True)
class _Search:
    """Regression of the error of the commands on the motion, for the delay and the stiffness.

    e = q_c(t − s) − q = X θ with X = (M q̈ − Q_C − Q_G, q̈, q̇, sgn q̇, 1) is linear in the unknowns of a joint
    for a given delay s, and θ₁ = 1/k_p. Noise of q is in e and in X. The instruments Z are therefore the same
    columns of the commanded motion at earlier times (two-stage least squares), with P = Q Qᵀ = Z Z⁺.

    Attributes:
        moved, asked: the measured and the commanded motion.
        rows: the rows used.
        joints: for each joint that moves, its number, a mask of rows in which it does, and Q.
    """

    moved: _Motion
    asked: _Motion
    rows: NDArray[np.int64]
    joints: list[tuple[int, NDArray[np.bool_], Array]]

    @classmethod
    def of(cls, signals: Signals, robot: RobotModel, mapping: Mapping) -> _Search:
        """Return the regression for a log.

        Raises:
            DataError: the log is too short, or no joint moves.
        """
        moved, asked = (_motion(signals, robot, mapping, name) for name in ("q", "command"))
        # Without rows at which the filter or the commands begin or end
        usable = np.asarray(np.isfinite(_shifted(moved.signals, asked.q, LONGEST)).all(axis=1))
        edge = mapping.sections.derivatives.window
        for run in moved.signals.runs():
            usable[run][:edge] = usable[run][-edge:] = False
        inner = np.flatnonzero(usable)
        if len(inner) <= FEWEST:
            raise DataError(
                "the log is too short to find the delay of its commands",
                expected="trajectories of a second or more",
                got=f"{np.ptp(signals.t):.3g} s in {len(moved.signals.runs())} trajectories",
                hint="state it, as in delay = 0.01 under [servo]",
            )
        rows = inner[np.unique(np.linspace(0, len(inner) - 1, min(len(inner), ROWS)).round().astype(int))]
        flat = asked.columns.reshape(len(asked.q), -1)
        shape = len(rows), *asked.columns.shape[1:]
        Z = np.concatenate([_shifted(moved.signals, flat, s)[rows].reshape(shape) for s in EARLIER], axis=-1)
        speed = np.abs(moved.qd[rows])
        fast = speed > MOVING * np.sqrt(np.square(speed).mean(axis=0))
        joints = [
            (j, moving, _orthogonal(Z[moving, j])) for j, moving in enumerate(fast.T) if moving.sum() > FEWEST
        ]
        if not joints:
            text, hint = (
                "the delay of the commands cannot be found",
                "state it, as in delay = 0.01 under [servo]",
            )
            raise DataError(
                text, expected=f"more than {FEWEST} rows in which a joint moves", got="none", hint=hint
            )
        return cls(moved, asked, rows, joints)

    def errors(self, delay: float) -> Array:
        """Return e in the rows for a delay."""
        return _shifted(self.moved.signals, self.asked.q, delay)[self.rows] - self.moved.q[self.rows]

    def delay(self) -> float:
        """Return the delay [s] with the least Σ |P (e − X θ)|²/σ² over the joints.

        Raises:
            DataError: the delay is longer than `LONGEST`.
        """

        def misfit(delay: float) -> float:
            """Return the sum over the joints."""
            e, X = self.errors(delay), self.moved.columns[self.rows]
            return sum(_unexplained(e[moving, j], X[moving, j], Q) for j, moving, Q in self.joints)

        tried = np.arange(0.0, LONGEST, STEP)
        best = tried[int(np.argmin([misfit(s) for s in tried]))]
        if best > LONGEST - 1.5 * STEP:
            raise DataError(
                "the delay of the commands cannot be found",
                expected=f"at most {LONGEST:g} s",
                got="commands that explain the motion better the later they are",
                hint="check the columns of the commands, or state it, as in delay = 0.15 under [servo]",
            )
        bounds = (max(0.0, best - 2.0 * STEP), best + 2.0 * STEP)
        return float(scipy.optimize.minimize_scalar(misfit, bounds=bounds, method="bounded").x)

    def stiffness(self, delay: float, unknown: NDArray[np.bool_]) -> Array:
        """Return 1/θ₁ (nq,), the stiffness of each joint, and NaN where it is not unknown.

        Raises:
            DataError: the links hardly resist the motion of a joint.
        """
        values, names = np.full(len(unknown), np.nan), self.moved.signals.joint_names
        e, X = self.errors(delay), self.moved.columns[self.rows]
        for j, moving, Q in self.joints:
            x, rest = Q.T @ X[moving, j, 0], Q.T @ X[moving, j, 1:]
            # What no other column explains of the first one, and θ₁ with its standard deviation
            alone = x - rest @ np.linalg.lstsq(rest, x, rcond=RANK)[0]
            power = float(alone @ alone)
            if power <= COLLINEAR**2 * float(x @ x):
                continue
            theta = float(alone @ (Q.T @ e[moving, j])) / power
            others = np.linalg.lstsq(rest, Q.T @ e[moving, j] - theta * x, rcond=RANK)[0]
            residual = e[moving, j] - theta * X[moving, j, 0] - X[moving, j, 1:] @ others
            if theta > CLEAR * float(np.sqrt(np.square(residual).mean() / power)):
                values[j] = 1.0 / theta
        lacking = [
            name for name, k, asked in zip(names, values, unknown, strict=True) if asked and np.isnan(k)
        ]
        if lacking:
            raise DataError(
                f"the motion does not determine the stiffness of {', '.join(lacking)}",
                expected="links that resist the motion of each joint",
                got="hardly any force of links, or a joint that hardly moves",
                hint=f"state it, as in stiffness = {{ {lacking[0]} = 20.0, … }} under [servo]",
            )
        return values


def _is_held(signals: Signals) -> bool:
    """Return whether commands move in steps of several rows."""
    changes = np.flatnonzero((np.diff(signals.vectors["command"], axis=0) != 0.0).any(axis=1))
    apart = np.diff(signals.t[changes])
    steps = (np.diff(changes) > 1) & (apart < HOLD)
    return bool(len(steps)) and float(steps.mean()) > HELD


def _orthogonal(Z: Array) -> Array:
    """Return an orthonormal basis of the columns of Z."""
    U, S, _ = np.linalg.svd(Z / np.sqrt(np.square(Z).mean(axis=0) + 1e-300), full_matrices=False)
    return U[:, RANK * S[0] < S]


def _unexplained(e: Array, X: Array, Q: Array) -> float:
    """Return |P (e − X θ)|²/σ² for the best θ, with P = Q Qᵀ and the mean square σ² of e − X θ."""
    X = X / np.sqrt(np.square(X).mean(axis=0) + 1e-300)
    theta, *_ = np.linalg.lstsq(Q.T @ X, Q.T @ e, rcond=RANK)
    rest = e - X @ theta
    return float(np.square(Q.T @ rest).sum() / (np.square(rest).mean() + 1e-300))
