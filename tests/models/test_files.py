"""Saved models: what is read back predicts the same, bit for bit; damage is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import safetensors.torch
import torch

import forcegp
from forcegp.errors import DestinationError, ModelError, UnknownNameError
from forcegp.gp.optimise import LearningOptions
from forcegp.models.analytical import AnalyticalFit
from forcegp.models.base import FittedModel
from forcegp.models.minibatch import BatchOptions
from forcegp.models.registry import MODELS, create
from forcegp.storage.model_file import model_path
from model_files import rewritten
from random_data import random_data, table_system

system = table_system()
data = random_data(system, 40)
test = random_data(system, 10, seed=1)
SHORT = LearningOptions("lbfgs", max_evaluations=4)
OPTIONS: dict[str, object] = {"nn": BatchOptions(epochs=2)}


def fitted(name: str) -> FittedModel:
    model = create(name, system, noise=0.1, seed=2)
    return model.fit(data, options=OPTIONS.get(name, SHORT))  # type: ignore[call-arg]


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    folder = tmp_path_factory.mktemp("models")

    def path_of(name: str) -> Path:
        if not model_path(folder / name).exists():
            fitted(name).save(folder / name)
        return model_path(folder / name)

    return path_of


@pytest.mark.parametrize("name", MODELS)
def test_round_trip_is_exact(name: str, tmp_path: Path) -> None:
    model = fitted(name)
    model.save(tmp_path / "model")
    read = forcegp.load_model(tmp_path / "model")
    assert type(read) is type(model)
    assert read.system.robot.fingerprint == model.system.robot.fingerprint
    assert tuple(read.system.contacts) == tuple(system.contacts)
    active = test.active(["table"])
    old = model.predict(test.q, test.qd, test.tau, active=active)
    new = read.predict(test.q, test.qd, test.tau, active=active)
    assert torch.equal(old.mean, new.mean)
    assert (old.covariance is None) == (new.covariance is None)
    assert old.covariance is None or torch.equal(old.covariance, new.covariance)  # type: ignore[arg-type]
    read.save(tmp_path / "again")
    first, again = (model_path(tmp_path / name).read_bytes() for name in ("model", "again"))
    assert first == again


def test_an_analytical_model_that_was_read_learns_the_same(tmp_path: Path) -> None:
    model = fitted("analytical")
    assert isinstance(model, AnalyticalFit)
    model.save(tmp_path / "model")
    read = forcegp.load_model(tmp_path / "model")
    assert isinstance(read, AnalyticalFit)
    start = system.with_robot(read.parameters.start)
    again = forcegp.AnalyticalModel(start, read.parameters.joints, read.window, read.seed)
    assert again.fit(data, options=SHORT).result.history == model.result.history


def test_a_surface_in_python_is_given_when_reading(tmp_path: Path) -> None:
    hill = forcegp.SurfaceContact(
        "hill",
        "lbr_iiwa_link_7",
        (0.0, 0.0, 0.1),
        forcegp.constraints.ImplicitSurface(lambda p: p[2] - 0.1 * p[0] ** 2),
    )
    bumpy = forcegp.ConstrainedSystem(system.robot, [hill])
    model = forcegp.AnalyticalModel(bumpy).nominal()
    model.save(tmp_path / "model")
    with pytest.raises(ModelError, match=r"load_model\(path, system=…\)"):
        forcegp.load_model(tmp_path / "model")
    read = forcegp.load_model(tmp_path / "model", system=bumpy)
    states = (test.q, test.qd, test.tau)
    assert torch.equal(read.predict(*states).mean, model.predict(*states).mean)


def test_a_folder_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").mkdir()
    with pytest.raises(DestinationError, match="is a folder"):
        forcegp.AnalyticalModel(system).nominal().save(tmp_path / "model")
    for _ in range(2):
        forcegp.AnalyticalModel(system).nominal().save(tmp_path / "other")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["model.safetensors", "other.safetensors"]


@pytest.mark.parametrize("keep", [0, 7, 100, 5000])
def test_truncated_files_are_refused(saved: Callable[[str], Path], tmp_path: Path, keep: int) -> None:
    (tmp_path / "short.safetensors").write_bytes(saved("gp").read_bytes()[:keep])
    with pytest.raises(ModelError, match=r"short\.safetensors"):
        forcegp.load_model(tmp_path / "short")


@pytest.mark.parametrize(
    ("name", "place", "value", "message"),
    [
        ("gp", "version", 99, "version 99"),
        ("gp", "version", 4, r"expected: version 5\s+got: version 4"),
        ("gp", "format", "pickle", "a different format"),
        ("gp", "kind", "oracle", "kind of models.*'oracle'"),
        ("gp", "settings.noise_std", "loud", "'settings.noise_std"),
        ("gp", "settings.noise_std", [0.1, -1.0], "'settings.noise_std"),
        ("gp", "settings.colour", "red", "'settings.colour'"),
        ("nn", "settings.hidden", [81], "'network.0.weight' does not fit"),
        ("nn", "settings.hidden", [0], "at least one unit"),
        ("analytical", "settings.analytical_parameters", {"weight": []}, "unknown quantity"),
        ("analytical", "settings.relative", None, "'settings.relative'"),
        ("analytical", "system.robot.parents", [0] * 7, "system.robot.parents.0"),
    ],
)
def test_a_changed_header_is_refused(
    saved: Callable[[str], Path], tmp_path: Path, name: str, place: str, value: object, message: str
) -> None:
    *path, last = place.split(".")

    def change(header: dict, tensors: dict) -> None:
        part = header
        for key in path:
            part = part[key]
        part[last] = value

    with pytest.raises((ModelError, UnknownNameError), match=message):
        forcegp.load_model(rewritten(saved(name), tmp_path / "model", change))


@pytest.mark.parametrize(
    ("name", "tensor"),
    [
        ("gp", "training.tau"),
        ("gp", "hyperparameters.qdd_3.log_std"),
        ("nn", "std.qdd"),
        ("nn", "network.2.bias"),
        ("analytical", "coordinates.damping"),
        ("analytical", "start.mass"),
        ("gp", "system.inertia"),
    ],
)
def test_a_tensor_that_is_missing_or_of_another_shape_is_named(
    saved: Callable[[str], Path], tmp_path: Path, name: str, tensor: str
) -> None:
    wrong = torch.ones(3, 2, dtype=torch.float64)
    for what, change in {
        "missing": lambda header, tensors: tensors.pop(tensor),
        "does not fit": lambda header, tensors: tensors.update({tensor: wrong}),
    }.items():
        file = rewritten(saved(name), tmp_path / what, change)
        with pytest.raises(ModelError, match=f"'{tensor}'.*{what}"):
            forcegp.load_model(file)


def test_no_model_is_there(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"none\.safetensors is not a saved model"):
        forcegp.load_model(tmp_path / "none")


def test_inputs_of_a_sparse_model_keep_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file does not keep the order of its tensors; kernels that read all inputs depend on theirs."""
    priors = [forcegp.priors.JointForcePrior()]
    model = forcegp.StructuredGP(system, "analytical", priors, 0.1, inference="sparse").fit(
        data, options=SHORT
    )
    model.save(tmp_path / "model")
    expected = model.predict(test.q, test.qd, test.tau).mean
    read = safetensors.torch.load
    for reverse in (False, True):
        monkeypatch.setattr(
            safetensors.torch, "load", lambda b, r=reverse: dict(sorted(read(b).items(), reverse=r))
        )
        found = forcegp.load_model(tmp_path / "model").predict(test.q, test.qd, test.tau).mean
        assert torch.equal(found, expected)
