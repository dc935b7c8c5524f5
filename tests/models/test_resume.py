"""An interrupted fit of any model resumes from its checkpoint and ends with the same bits."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch

import forcegp
from forcegp.errors import ModelError
from forcegp.models.minibatch import BatchOptions
from forcegp.storage import checkpoint as module
from random_data import random_data, table_system

DATA = random_data(table_system(), 30)
EPOCHS = BatchOptions(epochs=8, batch=8, patience=100)
CASES: dict[str, tuple[Callable[[], Any], Any]] = {
    "network": (lambda: forcegp.NeuralNetwork(table_system(), (5,)), EPOCHS),
    "analytical by epochs": (lambda: forcegp.AnalyticalModel(table_system()), EPOCHS),
    "analytical": (
        lambda: forcegp.AnalyticalModel(table_system()),
        forcegp.LearningOptions(max_evaluations=8, tolerance=0.0),
    ),
    "independent": (
        lambda: forcegp.IndependentGP(table_system(), noise=0.1),
        forcegp.LearningOptions(max_evaluations=4),
    ),
    "structured": (
        lambda: forcegp.StructuredGP(table_system(), "zero", noise=0.1),
        forcegp.LearningOptions(max_evaluations=8),
    ),
}


class Interruption:
    """Interrupts a fit at a call of its progress, and counts the calls."""

    def __init__(self, at: int | None = None) -> None:
        self.at, self.calls = at, 0

    def __call__(self, done: int, most: int, value: float) -> None:
        self.calls += 1
        if self.calls == self.at:
            raise KeyboardInterrupt


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> tuple[Callable[[], Any], Any]:
    monkeypatch.setattr(module, "INTERVAL", 0.0)
    return CASES[request.param]


def tensors(fit: Any) -> dict[str, torch.Tensor]:
    return fit.record()[1]


@pytest.mark.parametrize("at", [2, 5])
def test_a_resumed_fit_ends_with_the_same_bits(
    case: tuple[Callable[[], Any], Any], at: int, tmp_path: Path
) -> None:
    make, options = case
    file = tmp_path / "fit.ckpt"
    whole = make().fit(DATA, options=options)
    with pytest.raises(KeyboardInterrupt):
        make().fit(DATA, options=options, checkpoint=file, progress=Interruption(at))
    assert file.is_file()
    resumed = make().fit(DATA, options=options, checkpoint=file)
    assert resumed.result.history == whole.result.history
    expected, found = tensors(whole), tensors(resumed)
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in expected)
    assert file.is_file(), "kept until the caller has saved the fit"
    again = make().fit(DATA, options=options, checkpoint=file)
    assert again.result.history == whole.result.history


def test_a_training_by_epochs_does_not_repeat_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "INTERVAL", 0.0)
    make, options = CASES["network"]
    with pytest.raises(KeyboardInterrupt):
        make().fit(DATA, options=options, checkpoint=tmp_path / "c", progress=Interruption(6))
    rest = Interruption()
    make().fit(DATA, options=options, checkpoint=tmp_path / "c", progress=rest)
    assert rest.calls == options.epochs - 5, "the state after five epochs was on disk"


def test_a_checkpoint_of_other_data_is_refused(case: tuple[Callable[[], Any], Any], tmp_path: Path) -> None:
    make, options = case
    file = tmp_path / "fit.ckpt"
    make().fit(DATA, options=options, checkpoint=file)
    with pytest.raises(ModelError, match="belongs to a different fit"):
        make().fit(random_data(table_system(), 30, seed=9), options=options, checkpoint=file)


@pytest.mark.parametrize(
    "other",
    [{"standardize": False}, {"noise": forcegp.Noise(0.1, degrees_of_freedom=4.0)}, {"inducing_points": 7}],
)
def test_a_checkpoint_of_another_objective_is_refused(other: dict[str, Any], tmp_path: Path) -> None:
    file, options = tmp_path / "fit.ckpt", forcegp.LearningOptions(max_evaluations=3)
    forcegp.StructuredGP(table_system(), "zero", noise=0.1).fit(DATA, options=options, checkpoint=file)
    with pytest.raises(ModelError, match="belongs to a different fit"):
        forcegp.StructuredGP(table_system(), "zero", **{"noise": 0.1, **other}).fit(
            DATA, options=options, checkpoint=file
        )


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("weights.0.weight", float("nan"), "contains an implausible value"),
        ("history", float("inf"), "contains an implausible value"),
        ("exp_avg.0.weight", None, "belongs to a different fit"),
        ("generator", 7, "damaged"),
    ],
)
def test_a_damaged_state_is_refused(name: str, value: float | None, message: str, tmp_path: Path) -> None:
    make, options = CASES["network"]
    file = tmp_path / "fit.ckpt"
    make().fit(DATA, options=options, checkpoint=file)
    found = safetensors.torch.load_file(file)
    with safetensors.safe_open(file, "pt") as opened:
        key = opened.metadata()["key"]
    if value is None:
        del found[name]
    else:
        found[name] = torch.full_like(found[name], value)
    file.write_bytes(safetensors.torch.save(found, {"key": key}))
    with pytest.raises(ModelError, match=message):
        make().fit(DATA, options=options, checkpoint=file)
