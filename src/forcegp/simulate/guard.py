"""What every simulation loop has in common: torque limits, a bound on joint speeds, and progress."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.control.motion import MotionConfig
from forcegp.errors import NumericalError

RUNAWAY_SPEED = 50.0
"""A joint faster than this [rad/s] has left any planned motion."""
PROGRESS_STRIDE = 24
"""Steps between two calls of the progress function, a tenth of a second at 240 Hz."""

Progress = Callable[[int, int], None]
"""Called with the number of steps done and the number in all."""


def torque_limit(system: ConstrainedSystem, config: MotionConfig) -> Tensor:
    """Torque limits `(nq,)` [N m]: those of the settings, or else the robot's own."""
    robot = system.robot
    if config.torque_limit is None:
        return robot.effort_limit
    limit = torch.tensor(config.torque_limit, dtype=robot.dtype)
    robot.check_state(torque_limit=limit)
    return limit


def check_speed(t: float, q: np.ndarray, qd: np.ndarray) -> None:
    """Stop a run that diverges.

    Raises:
        NumericalError: a joint is too fast, or the state is not finite; names time and state.
    """
    if not (np.isfinite(q).all() and np.abs(qd).max() < RUNAWAY_SPEED):
        raise NumericalError(
            f"the simulation diverges at t = {t:.4f} s",
            expected=f"joint speeds below {RUNAWAY_SPEED:g} rad/s",
            got=f"q = {q.tolist()}, qd = {qd.tolist()}",
            hint="smaller gains, a longer travel time, or a rectangle further from the edge of the workspace",
        )


def report(progress: Progress | None, done: int, steps: int) -> None:
    """Call the progress function every few steps, and after the last."""
    if progress is not None and (done % PROGRESS_STRIDE == 0 or done == steps):
        progress(done, steps)
