"""The paper's task to look at: the motion of a held-out stretch in three dimensions, beside the page."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from forcegp.paper.fits import Fit
from forcegp.paper.task import Task
from forcegp.view.motion import of_log, sampled_rollout, with_rollout
from forcegp.view.page import write_view
from forcegp.view.shapes import shapes_of

VIEW = "view.html"
SAMPLES, AHEAD, SECONDS = 8, 1.0, 5.0
"""Function samples of the predicted paths, how far these reach, and the length of the motion [s]."""


def write_motion(root: Path, task: Task, fits: Sequence[Fit]) -> str | None:
    """Write the view of the first held-out stretch with the structured model that opens the page.

    Returns:
        The name of the file, or `None` where viser is not installed or no structured model was fitted.
    """
    structured = [fit for fit in fits if fit.task is task and fit.split == "stretches"]
    structured = [fit for fit in structured if fit.name.startswith("sgp") and not fit.name.endswith("-se")]
    if not structured or find_spec("viser") is None:
        return None
    model = max(structured, key=lambda fit: (fit.points, fit.name == "sgp-mean")).load()
    data = task.data[slice(*task.stretches()[0])]
    data = data[data.t <= data.t[0] + SECONDS]
    motion = with_rollout(of_log(task.system, data, model), sampled_rollout(model, data, SAMPLES, AHEAD))
    write_view(root / VIEW, motion, shapes_of(task.system.robot), "forcegp: the paper's task")
    return VIEW
