"""Torques that clip, exactly or behind the noise of a current, and those that only have peaks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import savgol_filter

import forcegp
from forcegp.checks import log_of
from forcegp.checks.limits import check_saturation
from logs import random_log

SYSTEM = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
ROWS = 3000


def clipped(limit: float, noise: float, window: int = 0) -> list[str]:
    """Joints that are found to clip in a log whose first torque is a sum of sines, clipped at a limit."""
    random = np.random.default_rng(0)
    t = 1e-3 * np.arange(ROWS)
    log = log_of(random_log(ROWS, joints=SYSTEM.robot.joint_names))
    tau, qd = (np.sin(2.0 * np.pi * f * t + 1.0) for f in (3.0, 1.7))
    tau = np.minimum(2.0 * tau, limit) + noise * random.standard_normal(ROWS)
    tau = savgol_filter(tau, window, 3) if window else tau
    other = np.column_stack([tau, 2.0 * np.sin(2.0 * np.pi * t)])
    findings, _ = check_saturation(SYSTEM, log.replace(t=t, tau=other, qd=np.column_stack([qd, qd])))
    assert all(finding.kind == "torque-saturated" for finding in findings)
    return [joint for finding in findings for joint in finding.joints]


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_torque_that_clips_is_named(noise: float) -> None:
    assert clipped(1.5, noise) == [SYSTEM.robot.joint_names[0]]


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_peaks_of_a_sine_are_no_limit(noise: float) -> None:
    assert clipped(10.0, noise) == []


def test_a_filter_that_overshoots_does_not_hide_a_limit() -> None:
    """`import` passes the torque through the filter of the accelerations."""
    assert clipped(1.5, 0.0, window=21) == [SYSTEM.robot.joint_names[0]]
    assert clipped(10.0, 0.0, window=21) == []
