"""Torques from which a driver has subtracted a model of the robot (`compensated` under `[torque]`).

Drivers publish different torques under one name: that of the motors, that of the motors without the torque
that carries the robot (`"gravity"`), or what a model of the robot does not explain (`"model"`). The import
adds the subtracted torque again, as the robot file has it.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from forcegp import dynamics
from forcegp.logs.mapping import Compensated, Mapping
from forcegp.logs.table import ImportReport, Signals
from forcegp.robot import RobotModel

CHUNK = 8192
"""Number of rows that are computed together."""
NAMED = {"gravity": "the gravity torque", "model": "the inverse dynamics"}


def subtracted(
    robot: RobotModel,
    compensated: Compensated,
    q: NDArray[np.float64],
    qd: NDArray[np.float64],
    qdd: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the torque that a driver subtracts, −Q_G or M q̈ − Q_C − Q_G, in states `(n, nq)` [N m, N].

    Example:
        >>> import forcegp
        >>> robot, still = forcegp.load_robot("double_pendulum"), np.zeros((1, 2))
        >>> lying = np.array([[np.pi / 2, 0.0]])
        >>> bool(np.allclose(*(subtracted(robot, how, lying, still, still) for how in ("gravity", "model"))))
        True
    """
    parts = []
    for first in range(0, len(q), CHUNK):
        x, v, a = (torch.from_numpy(np.ascontiguousarray(s[first : first + CHUNK])) for s in (q, qd, qdd))
        gravity = compensated == "gravity"
        parts.append(
            -dynamics.gravity_force(robot, x) if gravity else dynamics.inverse_dynamics(robot, x, v, a)
        )
    return torch.cat(parts).numpy() if parts else np.zeros_like(q)


def restore(signals: Signals, robot: RobotModel, mapping: Mapping, report: ImportReport) -> None:
    """Add the torque that the driver has subtracted to those of all measured joints."""
    torque = mapping.torque
    if torque.compensated is None:
        return
    q, qd, qdd = (signals.vectors[name] for name in ("q", "qd", "qdd"))
    measured = np.isin(signals.joint_names, mapping.measured("torque", signals.joint_names))
    added = subtracted(robot, torque.compensated, q, qd, qdd)
    signals.vectors["tau"] = signals.vectors["tau"] + added * measured
    text = f"added {NAMED[torque.compensated]} of the robot file to the torque, as the driver subtracts it"
    report.steps.append(text)
