"""A sweep on two workers: every fit is made once, and found again."""

from __future__ import annotations

from pathlib import Path

import pytest

from forcegp.models.load import load_model
from forcegp.sweep import fits_of, run_fit, sweep

pytestmark = pytest.mark.slow


def test_two_workers(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    fits = fits_of(["kuka_plane"], ["analytical"], [0, 1], duration=6.0)
    scores = sweep(fits, tmp_path, processes=2)
    assert [(score["model"], score["seed"]) for score in scores] == [("analytical", 0), ("analytical", 1)]
    for fit, score in zip(fits, scores, strict=True):
        written = (tmp_path / fit.name / "score.json").stat().st_mtime_ns
        assert run_fit(fit, str(tmp_path)) == score
        assert (tmp_path / fit.name / "score.json").stat().st_mtime_ns == written
        assert load_model(tmp_path / fit.name / "model").kind == "analytical"
    assert scores[0]["noisy_mae"] != scores[1]["noisy_mae"]
