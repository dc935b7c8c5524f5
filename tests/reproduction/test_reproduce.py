"""The whole line on ten seconds of motion, and its parts against what they are computed from."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from forcegp.data import Dataset
from forcegp.errors import DataError
from forcegp.models.load import load_model
from forcegp.models.structured_fit import StructuredFit
from forcegp.report.animation import animation_source
from forcegp.report.rollouts import RolloutData
from forcegp.report.window import WindowData
from reproduction.covariance import CovarianceData
from reproduction.multiplier import MultiplierData
from reproduction.profiles import Profile
from reproduction.results import Results
from reproduction.scores import RESIDUAL
from reproduction.stages import DATA
from reproduction.study import Reproduction, run
from reproduction.task import LOG
from reproduction.trajectories import together

TEN_SECONDS = Profile(
    "test",
    duration=10.0,
    seeds=1,
    sizes=(40,),
    paper_kernels_up_to=0,
    main=40,
    baseline_points=200,
    networks=("nn",),
    stretch=1.0,
    test_samples=200,
    multiplier_seconds=3.0,
    identification_points=30,
    identification_evaluations=30,
    rollout_seconds=1.0,
    rollout_starts=2,
    rollout_samples=3,
)

ROLLED_OUT = ["analytical", "nn", "gp", "sgp-zero", "sgp-mean", "sgp-contact"]
"""Models with trajectories."""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Reproduction:
    return run(TEN_SECONDS, tmp_path_factory.mktemp("reproduction"), seed=3)


def test_the_line_runs_from_the_robot_file_to_the_page(made: Reproduction) -> None:
    assert made.page.is_file() and made.reused == 0
    assert made.summary()["report"] == str(made.page)
    text = made.page.read_text(encoding="utf-8")
    assert text.count("<img") >= 25 and "Figure 5" in text
    assert (made.page.parent / "results.md").read_text(encoding="utf-8").startswith("# Results")
    read = Results.from_json((made.page.parent / "results.json").read_bytes(), "results.json", DataError)
    assert read == made.results


def test_every_model_is_scored_on_both_splits(made: Reproduction) -> None:
    names = {"analytical", "nn", "gp", "sgp-zero", "sgp-mean", "sgp-contact"}
    assert {(s.model, s.split) for s in made.results.scores} == {
        (name, split) for name in names for split in ("stretches", "selection")
    }
    for score in made.results.scores:
        # No model predicts noise: its mean magnitude bounds the error from below, up to sampling.
        assert score.noisy_mae > 0.07
        if score.model.startswith("sgp"):
            assert score.residual is not None and score.residual < RESIDUAL


def test_knowing_more_mechanics_is_better(made: Reproduction) -> None:
    error = {s.model: s.clean_mae for s in made.results.scores if s.split == "stretches"}
    assert all(e is not None for e in error.values())
    assert error["sgp-contact"] < error["sgp-mean"] < error["sgp-zero"]


def test_a_second_run_does_nothing_again(made: Reproduction) -> None:
    again = run(TEN_SECONDS, made.page.parent, seed=3)
    assert again.reused == again.stages == made.stages
    assert again.results == made.results


def test_the_paper_s_own_models_make_a_page(tmp_path: Path) -> None:
    sizes = dataclasses.replace(TEN_SECONDS, sizes=(20,), main=20, identification_evaluations=5, exact=True)
    made = run(sizes, tmp_path, seed=3)
    assert {s.model for s in made.results.scores} == {"analytical", "nn", "gp", "sgp-zero", "sgp-mean"}
    assert made.results.exact
    text = made.page.read_text(encoding="utf-8")
    assert "its kernel alone on inputs in their units" in text and "state where learning starts" in text
    model = load_model(next(tmp_path.glob("stages/fit/**/sgp-zero-20/model.safetensors")))
    assert isinstance(model, StructuredFit)
    assert model.hyperparameters["joint.log_lengthscale"].numel() == 147


def test_two_processes_make_the_same_page(made: Reproduction, tmp_path: Path) -> None:
    said: list[str] = []
    both = run(TEN_SECONDS, tmp_path, seed=3, processes=2, say=lambda line, *_: said.append(line))
    assert both.reused == 0 and both.stages == made.stages == len(set(said))
    for one, two in zip(made.results.scores, both.results.scores, strict=True):
        assert (one.model, one.split, one.points) == (two.model, two.split, two.points)
        assert two.noisy_mae == pytest.approx(one.noisy_mae, rel=1e-9)


def folder(made: Reproduction) -> Path:
    return made.page.parent / "stages" / "figures"


def test_the_covariance_is_the_operators_around_the_prior(made: Reproduction) -> None:
    path = folder(made) / "covariance" / DATA
    data = CovarianceData.from_json(path.read_bytes(), str(path), DataError)
    H = torch.block_diag(*torch.tensor(data.operators, dtype=torch.float64))
    k_Q = torch.tensor(data.force, dtype=torch.float64)
    K = torch.tensor(data.acceleration, dtype=torch.float64)
    # Entries are kept to seven digits.
    assert torch.allclose(H @ k_Q @ H.mT, K, atol=1e-4 * float(K.abs().max()))
    blocks = k_Q.unflatten(0, (-1, 7)).unflatten(2, (-1, 7)).transpose(1, 2)
    assert torch.equal(blocks, torch.diag_embed(blocks.diagonal(dim1=-2, dim2=-1)))
    # One direction a state is forbidden by the surface.
    assert data.rank <= len(K) - len(data.t)


def test_the_multiplier_is_the_simulators_with_the_known_mean(made: Reproduction) -> None:
    path = folder(made) / "multiplier" / DATA
    data = MultiplierData.from_json(path.read_bytes(), str(path), DataError)
    assert max(abs(c) for c in data.c) < 3e-4 and min(data.simulated) > 0.0
    mean = next(b for b in data.bands if b.model == "sgp-mean")
    assert mean.smallest > 0.0 and mean.mean_error < 1.0
    assert data.held_out and all(data.t[0] <= first < last <= data.t[-1] for first, last in data.held_out)


def test_windows_of_all_models_are_the_same_samples(made: Reproduction) -> None:
    windows = []
    for path in sorted(folder(made).glob(f"window/*/{DATA}")):
        windows.append(WindowData.from_json(path.read_bytes(), str(path), DataError))
    assert len(windows) == 6
    assert all(w.t == windows[0].t and w.measured == windows[0].measured for w in windows)
    assert windows[0].t[-1] - windows[0].t[0] == pytest.approx(1.0, abs=0.05)


def test_trajectories_of_all_models_start_where_an_unseen_motion_is(made: Reproduction) -> None:
    paths = [folder(made) / "rollouts" / name / DATA for name in ROLLED_OUT]
    data = together([RolloutData.from_json(path.read_bytes(), str(path), DataError) for path in paths])
    assert [p.model for p in data.models] == ROLLED_OUT
    assert data.horizons == [0.5, 1.0] and (data.starts, data.band_starts) == (2, 2)
    assert len(data.tip[0]) == len(data.t) == 241
    seen = Dataset.read(made.page.parent / "stages" / "simulate" / "seed-3" / LOG)
    unseen = Dataset.read(made.page.parent / "stages" / "simulate" / "rollout" / LOG)
    assert not torch.equal(seen.q[:240], unseen.q[:240])
    for model in data.models:
        # The tip is a robot's own, and the analytical model has learned the figures of its robot.
        assert model.tip_error[0] < 1e-3
        structured = model.model.startswith("sgp")
        assert (model.coverage is not None) == structured == bool(model.tip_bands)
        assert model.inflation is model.calibrated_coverage is None, "too few trajectories to calibrate with"
        if structured:
            assert len(model.tip_bands[0].lower) == len(data.t)
        # Nothing holds models of accelerations on the surface.
        assert (max(abs(c) for c in model.drift) < 1e-3) == (model.model not in ("nn", "gp"))


def test_results_and_page_have_the_trajectories(made: Reproduction) -> None:
    assert "| after 1 s [mm] |" in (made.page.parent / "results.md").read_text(encoding="utf-8")
    text = made.page.read_text(encoding="utf-8")
    assert "Trajectories predicted in open loop" in text and "Tip error of trajectories" in text
    assert "<canvas" in text and f"script-src '{animation_source()}'" in text
