"""Which fits a reproduction makes, and on which rows."""

from __future__ import annotations

import torch

from forcegp.data import Split
from forcegp.paper.jobs import models_of
from forcegp.paper.profiles import profile_of
from forcegp.paper.task import Task
from logs import random_log


def test_structured_models_alone_see_the_whole_log() -> None:
    large = profile_of("large")
    whole = large.sparse_sizes[-1]
    held = [name for name, points in models_of(large, "stretches") if points == whole]
    assert held == ["sgp-zero", "sgp-mean", "sgp-contact"]
    assert all(
        points <= max(large.baseline_points, *large.sizes) for _, points in models_of(large, "selection")
    )
    assert max(points for name, points in models_of(large, "stretches") if name == "gp") == 1000


def test_more_points_than_were_selected_are_evenly_spaced_and_not_held_out() -> None:
    data, test = random_log(100), torch.arange(40, 60)
    task = Task.__new__(Task)
    object.__setattr__(task, "data", data)
    object.__setattr__(task, "splits", {"stretches": Split(torch.tensor([7, 3]), test)})
    assert torch.equal(task.train("stretches", 2).t, data.t[[7, 3]])
    rest = torch.cat([data.t[:40], data.t[60:]])
    assert torch.equal(task.train("stretches", 1000).t, rest)
    few = task.train("stretches", 5).t
    assert len(few) == 5 and bool(torch.isin(few, rest).all())
