"""A checkpoint resumes a fit to the same bits, belongs to one fit of one system, and is checked when read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import safetensors
import safetensors.torch
import torch
from torch import Tensor

import forcegp
from forcegp.errors import ModelError
from forcegp.gp.optimise import LearningOptions, minimise
from forcegp.storage import checkpoint as module
from forcegp.storage.checkpoint import Checkpoint, Evaluations
from random_data import random_data, table_system

START = {
    "b": torch.tensor([-1.2, 1.0, 0.3], dtype=torch.float64),
    "a": torch.tensor(2.0, dtype=torch.float64),
}


class Counted:
    """Rosenbrock's function and a bowl, which counts its evaluations and may die at one of them."""

    def __init__(self, dies_at: int | None = None) -> None:
        self.calls, self.dies_at = 0, dies_at

    def __call__(self, tensors: dict[str, Tensor]) -> Tensor:
        self.calls += 1
        if self.calls == self.dies_at:
            raise KeyboardInterrupt
        b = tensors["b"]
        valley = (100.0 * (b[1:] - b[:-1] ** 2) ** 2 + (1.0 - b[:-1]) ** 2).sum()
        return valley + tensors["a"].square()


@pytest.fixture
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Evaluations]:
    monkeypatch.setattr(module, "INTERVAL", 0.0)
    return lambda: Evaluations(Checkpoint(tmp_path / "fit.ckpt", "key"))


@pytest.mark.parametrize("optimizer", ["lbfgs", "adam"])
@pytest.mark.parametrize("dies_at", [2, 3, 17])
def test_a_resumed_fit_ends_with_the_same_bits(
    optimizer: str, dies_at: int, fresh: Callable[[], Evaluations]
) -> None:
    options = LearningOptions(optimizer, max_evaluations=60)  # type: ignore[arg-type]
    whole = minimise(Counted(), START, options)
    broken = fresh()
    assert broken.read(START) == 0
    with pytest.raises(KeyboardInterrupt):
        minimise(broken.recorded(Counted(dies_at)), START, options)
    again, counted = fresh(), Counted()
    assert again.read(START) == dies_at - 1
    resumed = minimise(again.recorded(counted), START, options)
    assert resumed.history == whole.history
    assert all(torch.equal(whole.tensors[name], resumed.tensors[name]) for name in START)
    assert counted.calls == whole.evaluations - (dies_at - 1), "nothing is evaluated twice"


def test_another_path_than_the_recorded_one_is_evaluated_anew(fresh: Callable[[], Evaluations]) -> None:
    first = fresh()
    minimise(first.recorded(Counted()), START, LearningOptions(max_evaluations=10))
    again, counted = fresh(), Counted()
    assert again.read(START) == 10
    other = {"b": START["b"] + 1e-9, "a": START["a"]}
    resumed = minimise(again.recorded(counted), other, LearningOptions(max_evaluations=10))
    assert counted.calls == 10
    assert resumed.history == minimise(Counted(), other, LearningOptions(max_evaluations=10)).history


def test_writing_waits_for_its_interval_and_ends_before_what_is_not_finite(
    fresh: Callable[[], Evaluations], monkeypatch: pytest.MonkeyPatch
) -> None:
    saved = fresh()
    objective = saved.recorded(lambda tensors: (tensors["a"] / tensors["b"][0]).sum())
    objective(START)
    monkeypatch.setattr(module, "INTERVAL", 1e9)
    objective({"b": START["b"], "a": START["a"] + 1.0})
    assert fresh().read(START) == 1
    objective({"b": torch.zeros(3, dtype=torch.float64), "a": START["a"]})
    saved.write()
    assert fresh().read(START) == 2


def written(saved: Evaluations, key: str = "key", **changes: Tensor) -> None:
    size = 4
    tensors = {
        "positions": torch.zeros(2, size, dtype=torch.float64),
        "objectives": torch.zeros(2, dtype=torch.float64),
        "gradients": torch.zeros(2, size, dtype=torch.float64),
    }
    saved.checkpoint.path.write_bytes(safetensors.torch.save(tensors | changes, {"key": key}))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e300])
@pytest.mark.parametrize("name", ["positions", "objectives", "gradients"])
def test_impossible_values_are_refused(value: float, name: str, fresh: Callable[[], Evaluations]) -> None:
    saved = fresh()
    shape = (2,) if name == "objectives" else (2, 4)
    written(saved, **{name: torch.full(shape, value, dtype=torch.float64)})
    with pytest.raises(ModelError, match=f"'{name}' .*implausible value"):
        saved.read(START)


def writable(dtype: torch.dtype) -> bool:
    """Whether the installed safetensors writes a type; older releases know no complex numbers."""
    try:
        safetensors.torch.save({"a": torch.ones(1, dtype=dtype)})
    except (KeyError, ValueError, safetensors.SafetensorError):
        return False
    return True


def test_other_shapes_types_and_keys_are_refused(fresh: Callable[[], Evaluations]) -> None:
    saved = fresh()
    written(saved)
    assert saved.read(START) == 2
    for wrong in (
        {"more": torch.zeros(2)},
        {"positions": torch.zeros(2, 5, dtype=torch.float64)},
        {"objectives": torch.zeros((), dtype=torch.float64)},
        {"gradients": torch.zeros(2, 4, dtype=torch.float32)},
        *([{"gradients": torch.zeros(2, 4, dtype=torch.complex64)}] if writable(torch.complex64) else []),
    ):
        written(saved, **wrong)
        with pytest.raises(ModelError, match="belongs to a different fit"):
            saved.read(START)
    written(saved, positions=torch.zeros(3, 4, dtype=torch.float64))
    with pytest.raises(ModelError, match="their number differs"):
        saved.read(START)
    written(saved, key="other")
    with pytest.raises(ModelError, match="belongs to a different fit"):
        saved.read(START)


def test_a_folder_or_a_huge_or_damaged_file_is_refused(
    fresh: Callable[[], Evaluations], monkeypatch: pytest.MonkeyPatch
) -> None:
    saved = fresh()
    saved.checkpoint.path.mkdir()
    with pytest.raises(ModelError, match="is not a file"):
        saved.read(START)
    saved.checkpoint.path.rmdir()
    written(saved)
    whole = saved.checkpoint.path.read_bytes()
    for cut in (0, 4, 8, 20, len(whole) - 1):
        saved.checkpoint.path.write_bytes(whole[:cut])
        with pytest.raises(ModelError, match="damaged"):
            saved.read(START)
    monkeypatch.setattr(module, "CHECKPOINT_BYTES", 10)
    saved.checkpoint.path.write_bytes(whole)
    with pytest.raises(ModelError, match="too large"):
        saved.read(START)


def system(offset: float = 0.055, mass: float = 1.0) -> forcegp.ConstrainedSystem:
    base = table_system()
    surface = forcegp.Plane((0.0, 0.0, 1.0), offset)
    contact = forcegp.SurfaceContact("table", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), surface)
    robot = base.robot.replace(mass=base.robot.mass * mass)
    return forcegp.ConstrainedSystem(robot, [contact], baumgarte=base.baumgarte)


def test_the_digest_knows_shapes_and_types() -> None:
    flat, square = torch.zeros(4), torch.zeros(2, 2)
    assert Checkpoint.key_of(flat) == Checkpoint.key_of(flat.clone())
    assert Checkpoint.key_of(flat) != Checkpoint.key_of(square)
    assert Checkpoint.key_of(flat) != Checkpoint.key_of(torch.zeros(2, dtype=torch.float64))


def interrupt(at: int) -> Callable[[int, int, float], None]:
    def stop(done: int, most: int, value: float) -> None:
        if done == at:
            raise KeyboardInterrupt

    return stop


def test_a_checkpoint_of_another_robot_or_surface_is_refused(fresh: Callable[[], Evaluations]) -> None:
    data, path = random_data(system(), 6), fresh().checkpoint.path
    options = LearningOptions(max_evaluations=5, warm_start=None)
    with pytest.raises(KeyboardInterrupt):
        forcegp.StructuredGP(system(), "zero", noise=0.1).fit(
            data, options=options, progress=interrupt(2), checkpoint=path
        )
    for other in (system(offset=0.06), system(mass=1.01)):
        with pytest.raises(ModelError, match="belongs to a different fit"):
            forcegp.StructuredGP(other, "zero", noise=0.1).fit(data, options=options, checkpoint=path)


def test_a_resumed_fit_with_restarts_keeps_the_best_and_its_file(
    fresh: Callable[[], Evaluations],
) -> None:
    data, path = random_data(system(), 12), fresh().checkpoint.path
    options = LearningOptions(max_evaluations=4, warm_start=4, restarts=1)
    whole = forcegp.StructuredGP(system(), "zero", noise=0.1).fit(data, options=options)
    seen: list[int] = []

    def stop(done: int, most: int, value: float) -> None:
        seen.append(done)
        if len(seen) == 6:
            raise KeyboardInterrupt

    model = forcegp.StructuredGP(system(), "zero", noise=0.1)
    with pytest.raises(KeyboardInterrupt):
        model.fit(data, options=options, progress=stop, checkpoint=path)
    resumed = model.fit(data, options=options, checkpoint=path)
    assert resumed.result.objective == whole.result.objective
    assert resumed.result.history == whole.result.history
    assert model.fit(data, options=options, checkpoint=path).result.objective == whole.result.objective
    assert path.is_file()
