"""A checkpoint holds the best values, belongs to one fit of one system, and is checked when it is read."""

from __future__ import annotations

from pathlib import Path

import pytest
import safetensors.torch
import torch

import forcegp
from forcegp.errors import ModelError
from forcegp.gp.optimise import LearningOptions
from forcegp.storage import checkpoint as module
from forcegp.storage.checkpoint import Checkpoint
from random_data import random_data, table_system

START = {"a": torch.zeros(2, dtype=torch.float64), "b": torch.ones((), dtype=torch.float64)}


def values(number: float) -> dict[str, torch.Tensor]:
    return {name: torch.full_like(value, number) for name, value in START.items()}


@pytest.fixture
def saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Checkpoint:
    monkeypatch.setattr(module, "INTERVAL", 0.0)
    return Checkpoint(tmp_path / "fit.ckpt", "key")


def test_the_best_of_all_restarts_is_kept(saved: Checkpoint) -> None:
    note = saved.noting(None)
    best = values(0.0)
    for restart, objectives in enumerate(([5.0, 3.0, 4.0], [9.0, 2.0, 8.0], [7.0, 6.0])):
        lowest = float("inf")
        for evaluation, objective in enumerate(objectives):
            if objective < lowest:
                lowest, best = objective, values(10.0 * restart + evaluation)
            note(evaluation, objective, best)
    found = saved.read(START)
    assert found is not None
    assert torch.equal(found["a"], values(11.0)["a"]), "the second evaluation of the second restart"


def test_what_is_found_between_two_writings_is_written_later(
    saved: Checkpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    note = saved.noting(None)
    note(1, 3.0, values(1.0))
    monkeypatch.setattr(module, "INTERVAL", 1e9)
    note(2, 2.0, values(2.0))
    monkeypatch.setattr(module, "INTERVAL", 0.0)
    note(3, 4.0, values(2.0))
    found = saved.read(START)
    assert found is not None and torch.equal(found["a"], values(2.0)["a"])


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e13, -1e300])
def test_impossible_values_are_refused(value: float, saved: Checkpoint) -> None:
    saved.noting(None)(1, 0.0, values(value))
    with pytest.raises(ModelError, match="holds a value that no fit reaches"):
        saved.read(START)


def test_other_shapes_types_and_keys_are_refused(saved: Checkpoint) -> None:
    for wrong in (
        {"a": START["a"]},
        {**START, "c": torch.zeros(1)},
        {**START, "a": torch.zeros(3, dtype=torch.float64)},
        {**START, "a": torch.zeros(2, dtype=torch.float32)},
        {**START, "a": torch.zeros(2, dtype=torch.complex64)},
    ):
        saved.path.write_bytes(safetensors.torch.save(wrong, {"key": "key"}))
        with pytest.raises(ModelError, match="belongs to another fit"):
            saved.read(START)
    saved.path.write_bytes(safetensors.torch.save(START, {"key": "other"}))
    with pytest.raises(ModelError, match="belongs to another fit"):
        saved.read(START)


def test_a_folder_or_a_huge_or_damaged_file_is_refused(
    saved: Checkpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved.path.mkdir()
    with pytest.raises(ModelError, match="is no file"):
        saved.read(START)
    saved.path.rmdir()
    whole = safetensors.torch.save(START, {"key": "key"})
    for cut in (0, 4, 8, 20, len(whole) - 1):
        saved.path.write_bytes(whole[:cut])
        with pytest.raises(ModelError, match="damaged"):
            saved.read(START)
    monkeypatch.setattr(module, "CHECKPOINT_BYTES", 10)
    saved.path.write_bytes(whole)
    with pytest.raises(ModelError, match="too large"):
        saved.read(START)


def system(offset: float = 0.055, mass: float = 1.0) -> forcegp.ConstrainedSystem:
    base = table_system()
    surface = forcegp.Plane((0.0, 0.0, 1.0), offset)
    contact = forcegp.SurfaceContact("table", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), surface)
    robot = base.robot.replace(mass=base.robot.mass * mass)
    return forcegp.ConstrainedSystem(robot, [contact], baumgarte=base.baumgarte)


def test_the_key_knows_robot_surface_and_shapes() -> None:
    assert Checkpoint.key_of(system()) == Checkpoint.key_of(system())
    assert Checkpoint.key_of(system()) != Checkpoint.key_of(system(offset=0.056))
    assert Checkpoint.key_of(system()) != Checkpoint.key_of(system(mass=1.01))
    flat, square = torch.zeros(4), torch.zeros(2, 2)
    assert Checkpoint.key_of(flat) != Checkpoint.key_of(square)
    assert Checkpoint.key_of(flat) != Checkpoint.key_of(torch.zeros(2, dtype=torch.float64))


def test_a_checkpoint_of_another_surface_is_refused_by_a_fit(saved: Checkpoint) -> None:
    def stop(done: int, most: int, value: float) -> None:
        if done == 2:
            raise KeyboardInterrupt

    data = random_data(system(), 8)
    options = LearningOptions(max_evaluations=20, warm_start=None)

    def model(offset: float) -> forcegp.StructuredGP:
        return forcegp.StructuredGP(system(offset), noise_std=0.1)

    with pytest.raises(KeyboardInterrupt):
        model(0.055).fit(data, options=options, progress=stop, checkpoint=saved.path)
    with pytest.raises(ModelError, match="belongs to another fit"):
        model(0.06).fit(data, options=options, checkpoint=saved.path)


def test_a_resumed_fit_ends_within_the_documented_tolerance(saved: Checkpoint) -> None:
    def stop(done: int, most: int, value: float) -> None:
        if done == 4:
            raise KeyboardInterrupt

    data = random_data(system(), 12)
    options = LearningOptions(max_evaluations=200, warm_start=None, tolerance=1e-8)
    whole = forcegp.StructuredGP(system(), noise_std=0.1).fit(data, options=options)
    broken = forcegp.StructuredGP(system(), noise_std=0.1)
    with pytest.raises(KeyboardInterrupt):
        broken.fit(data, options=options, progress=stop, checkpoint=saved.path)
    again = forcegp.StructuredGP(system(), noise_std=0.1)
    resumed = again.fit(data, options=options, checkpoint=saved.path)
    assert min(resumed.history) <= min(whole.history[:4]), "it goes on where it was"
    # "A few times the tolerance", relative to the objective: 1e-8 times 1000 evaluations at most.
    assert abs(resumed.objective - whole.objective) < 1e-5 * abs(whole.objective)
