"""Torques that a controller computes from a model, and does not measure.

Motors and sensors are noisy, and a motor has friction. Some controllers publish the output of their model of
the arm as its torque.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from forcegp.identification import regressor
from forcegp.logs.mapping import Mapping
from forcegp.logs.table import Array, ImportReport, Signals
from forcegp.robot import RobotModel

NOISE = 2e-6
"""White noise of a torque over its RMS below which it is not measured. The `Torque` of a Kinova Gen3 has
less than 1.3e-6, and its currents have .008 to .9; filtered torques of an iiwa 14 have 6e-6 and more."""
EXPLAINED, FREE = 0.2, 1.2
"""Residual of a model over the RMS torque, .01 to .06 for this `Torque` in the median over its joints; and
ratio of residuals without and with friction below which a torque has none: 1.0 for this `Torque`, in the
median over its joints, and 7 for the currents of a UR10, whose driver filters them to a noise below 1e-9."""
ROWS, RISE, RIDGE, CHANGES, FEWEST = 3000, 0.02, 1e-4, 0.5, 100
"""Maximum number of rows in this regression, speed over which dry friction rises [rad/s, m/s], relative ridge
penalty, least share of rows in which a torque must change, and fewest rows."""


def without_noise(signals: Signals, mapping: Mapping) -> NDArray[np.bool_]:
    """Return a mask `(nq,)` of the measured torques that change without noise, before any filter."""
    tau = signals.vectors["tau"]
    steps = [np.diff(tau[run], axis=0) for run in signals.runs() if run.stop - run.start > 6]
    measured = ~np.isin(signals.joint_names, mapping.torque.unmeasured)
    if mapping.sections.torque is None or sum(map(len, steps)) < FEWEST:
        return np.zeros_like(measured)
    changes = np.mean(np.concatenate(steps) != 0.0, axis=0) > CHANGES
    sixth = np.concatenate([np.diff(each, 5, axis=0) for each in steps])
    # White noise σ has sixth differences of variance 924 σ², and a squared normal deviate the median 0.4549
    noise = np.sqrt(np.median(sixth**2, axis=0) / (924.0 * 0.4549))
    return measured & changes & (noise < NOISE * np.sqrt(np.mean(tau**2, axis=0)))


def find_modelled(
    signals: Signals, smooth: NDArray[np.bool_], robot: RobotModel, report: ImportReport
) -> None:
    """Report torques without noise that no joint friction changes, if most torques are of this kind."""
    n = len(signals)
    if 2 * smooth.sum() <= len(smooth) or n < FEWEST:
        return
    rows = np.unique(np.linspace(0, n - 1, min(n, ROWS)).round().astype(int))
    q, qd, qdd, tau = (signals.vectors[name][rows] for name in ("q", "qd", "qdd", "tau"))
    Y = regressor(robot, *(torch.from_numpy(np.ascontiguousarray(x)) for x in (q, qd, qdd))).numpy()
    sizes, ratios = [], []
    for j in np.flatnonzero(smooth):
        inertial = np.column_stack([Y[:, j], qdd[:, j], np.ones(len(rows))])
        friction = np.column_stack([qd[:, j], np.tanh(qd[:, j] / RISE)])
        without_friction, with_friction = (
            _unexplained(X, tau[:, j]) for X in (inertial, np.column_stack([inertial, friction]))
        )
        sizes.append(without_friction / max(float(np.sqrt(np.mean(tau[:, j] ** 2))), 1e-300))
        ratios.append(without_friction / max(with_friction, 1e-300))
    if np.median(ratios) < FREE and np.median(sizes) < EXPLAINED:
        names = ", ".join(np.array(signals.joint_names)[smooth])
        text = f"the torque of {names} has neither noise nor friction: the output of a model or a simulator"
        report.find("modelled", text)


def _unexplained(X: Array, y: Array) -> float:
    """Return the RMS residual of y `(n,)` for the columns X."""
    X = X / np.sqrt(np.mean(X**2, axis=0)).clip(min=1e-12)
    penalty = RIDGE * np.sqrt(len(X)) * np.eye(X.shape[1])
    w = np.linalg.lstsq(np.vstack([X, penalty]), np.append(y, np.zeros(len(penalty))), rcond=None)[0]
    return float(np.sqrt(np.mean((y - X @ w) ** 2)))
