"""Which fits a reproduction makes, on which rows, and what the view beside its page shows."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import forcegp
from forcegp.data import Split
from forcegp.errors import UnknownNameError
from forcegp.view.motion import Motion
from logs import random_log
from reproduction import study
from reproduction.fits import LARGE, models_of
from reproduction.profiles import PROFILES, profile_of
from reproduction.study import plan_of, viewed
from reproduction.task import Task


def test_profiles_are_found_by_name() -> None:
    assert profile_of("paper").seeds >= 3
    with pytest.raises(UnknownNameError, match="did you mean 'quick'"):
        profile_of("quik")


def test_structured_models_alone_see_the_whole_log() -> None:
    large = profile_of("large")
    whole = large.sparse_sizes[-1]
    held = [name for name, points in models_of(large, "stretches") if points == whole]
    assert held == ["sgp-zero", "sgp-mean", "sgp-contact"]
    assert all(
        points <= max(large.baseline_points, *large.sizes) for _, points in models_of(large, "selection")
    )
    assert max(points for name, points in models_of(large, "stretches") if name == "gp") == 1000


@pytest.mark.parametrize("name", PROFILES)
def test_large_fits_start_from_the_next_smaller_one(name: str, tmp_path: Path) -> None:
    plan = plan_of(tmp_path, profile_of(name), 3)
    assert len({stage.name for stage in plan.stages()}) == len(plan.stages())
    for fit in plan.fits:
        same = [f for f in plan.fits if (f.name, f.split, f.seed) == (fit.name, fit.split, fit.seed)]
        smaller = [f for f in same if LARGE <= f.points < fit.points]
        before = [max(smaller, key=lambda f: f.points).stage] if smaller else []
        assert list(fit.stage.inputs[2:]) == before


def test_more_points_than_were_selected_are_evenly_spaced_and_not_held_out() -> None:
    data, test = random_log(100), torch.arange(40, 60)
    system: Any = None
    task = Task(0, system, data, {"stretches": Split(torch.tensor([7, 3]), test)})
    assert torch.equal(task.train("stretches", 2).t, data.t[[7, 3]])
    rest = torch.cat([data.t[:40], data.t[60:]])
    assert torch.equal(task.train("stretches", 1000).t, rest)
    few = task.train("stretches", 5).t
    assert len(few) == 5 and bool(torch.isin(few, rest).all())


def test_the_view_shows_the_largest_structured_model() -> None:
    names = (("gp", 90), ("sgp-mean", 40), ("sgp-zero", 80), ("sgp-mean", 80), ("sgp-mean-se", 80))
    fits: Any = [SimpleNamespace(name=name, points=points) for name, points in names]
    assert viewed(fits) == [fits[3]]
    assert viewed(fits[:1]) == []


def test_the_view_shows_the_first_held_out_stretch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unchecked: None
) -> None:
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    t = 0.01 * torch.arange(60, dtype=torch.float64)
    q, tau = torch.zeros(60, 2, dtype=torch.float64), torch.zeros(60, 2, dtype=torch.float64)
    data = forcegp.Dataset(t=t, q=q, qd=q, tau=tau, qdd=q, joint_names=system.robot.joint_names)
    task = Task(0, system, data, {"stretches": Split(t[:20].long(), t[20:].long(), ((20, 60),))})
    written: dict[str, Any] = {}

    def write(path: Path, shown: Motion, *_: object) -> None:
        written[path.name] = shown

    monkeypatch.setattr(study, "write_view", write)
    monkeypatch.setattr(study, "load_model", lambda _: forcegp.AnalyticalModel(system).nominal())
    monkeypatch.setattr(study.Task, "read", lambda *_: task)
    study.make_view(tmp_path, tmp_path, tmp_path, tmp_path)
    shown = written["view.html"]
    assert [path.kind for path in shown.paths] == ["logged", "predicted"]
    assert shown.t[-1] == pytest.approx(0.35, abs=0.051), "of forty rows, twenty pictures a second"
