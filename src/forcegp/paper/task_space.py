"""Figure 3: planned and executed position, velocity and acceleration of the tool."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from forcegp.report.data import TaskSpaceData, columns, matrix, series

VECTORS = (
    "planned_position", "planned_velocity", "planned_acceleration", "position", "velocity", "acceleration",
)  # fmt: skip


def task_space_motion(t: Tensor, motion: Mapping[str, Tensor], rows: Tensor) -> TaskSpaceData:
    """The motion of the tool at some samples, with the points that it passes.

    Args:
        t: `(n,)` times of the log [s].
        motion: as a simulation leaves it.
        rows: which samples.
    """
    last = int(motion["segment"][rows].max())
    first = int(motion["segment"][rows].min())
    return TaskSpaceData(
        t=series(t[rows]),
        waypoints=matrix(motion["waypoints"][torch.arange(first + 1, last + 1)]),
        **{name: columns(motion[name][rows]) for name in VECTORS},
    )
