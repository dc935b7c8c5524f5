"""The view beside the page of a reproduction."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import forcegp
from forcegp.paper import motion
from forcegp.view.motion import Motion


def test_the_largest_structured_model_is_shown_on_the_first_held_out_stretch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unchecked: None
) -> None:
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    t = 0.01 * torch.arange(60, dtype=torch.float64)
    q, tau = torch.zeros(60, 2, dtype=torch.float64), torch.zeros(60, 2, dtype=torch.float64)
    data = forcegp.Dataset(t=t, q=q, qd=q, tau=tau, qdd=q, joint_names=system.robot.joint_names)
    task = SimpleNamespace(system=system, data=data, stretches=lambda: [(20, 60)])
    loaded: list[str] = []

    def fit(name: str, points: int) -> SimpleNamespace:
        def load() -> forcegp.AnalyticalModel:
            loaded.append(f"{name} {points}")
            return forcegp.AnalyticalModel(system)

        return SimpleNamespace(name=name, points=points, task=task, split="stretches", load=load)

    written: dict[str, Any] = {}

    def write(path: Path, shown: Motion, *_: object) -> None:
        written[path.name] = shown

    monkeypatch.setattr(motion, "write_view", write)
    monkeypatch.setattr(motion, "find_spec", lambda _: object())
    fits: Any = [fit("gp", 90), fit("sgp-mean", 40), fit("sgp-mean", 80), fit("sgp-mean-se", 80)]
    assert motion.write_motion(tmp_path, task, fits) == "view.html"  # pyright: ignore[reportArgumentType]
    assert loaded == ["sgp-mean 80"]
    shown = written["view.html"]
    assert [path.kind for path in shown.paths] == ["logged", "predicted"]
    assert shown.t[-1] == pytest.approx(0.35, abs=0.051), "of forty rows, twenty pictures a second"
    assert motion.write_motion(tmp_path, task, fits[:1]) is None  # pyright: ignore[reportArgumentType]
