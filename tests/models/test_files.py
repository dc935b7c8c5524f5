"""Saved models: what is read back predicts the same, bit for bit; damage is named."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import safetensors.torch
import torch

import forcegp
from forcegp.errors import ModelError, UnknownNameError
from forcegp.gp.optimise import LearningOptions
from forcegp.models.analytical import AnalyticalFit
from forcegp.models.base import FittedModel
from forcegp.models.minibatch import BatchOptions
from forcegp.models.registry import MODELS, create
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
        if not (folder / name).exists():
            fitted(name).save(folder / name)
        return folder / name

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
    for file in ("model.json", "model.safetensors"):
        assert (tmp_path / "model" / file).read_bytes() == (tmp_path / "again" / file).read_bytes()


def test_an_analytical_model_that_was_read_learns_the_same(tmp_path: Path) -> None:
    model = fitted("analytical")
    assert isinstance(model, AnalyticalFit)
    model.save(tmp_path / "model")
    read = forcegp.load_model(tmp_path / "model")
    assert isinstance(read, AnalyticalFit)
    start = system.with_robot(read.parameters.start)
    again = forcegp.AnalyticalModel(start, read.parameters.joints, read.window, read.seed)
    assert again.fit(data, options=SHORT).history == model.history


def test_a_surface_in_python_is_given_when_reading(tmp_path: Path) -> None:
    hill = forcegp.SurfaceContact(
        "hill", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), forcegp.ImplicitSurface(lambda p: p[2] - 0.1 * p[0] ** 2)
    )
    bumpy = forcegp.ConstrainedSystem(system.robot, [hill])
    model = forcegp.AnalyticalModel(bumpy).nominal()
    model.save(tmp_path / "model")
    with pytest.raises(ModelError, match=r"load_model\(path, system=…\)"):
        forcegp.load_model(tmp_path / "model")
    read = forcegp.load_model(tmp_path / "model", system=bumpy)
    states = (test.q, test.qd, test.tau)
    assert torch.equal(read.predict(*states).mean, model.predict(*states).mean)


def test_other_folders_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ModelError, match="holds other files than a model"):
        forcegp.AnalyticalModel(system).nominal().save(tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"
    for _ in range(2):
        forcegp.AnalyticalModel(system).nominal().save(tmp_path / "model")
    assert sorted(f.name for f in (tmp_path / "model").iterdir()) == ["model.json", "model.safetensors"]


def copied(source: Path, folder: Path) -> Path:
    folder.mkdir()
    for file in source.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    return folder


@pytest.mark.parametrize("keep", [0, 7, 100, 5000])
def test_truncated_files_are_refused(saved: Callable[[str], Path], tmp_path: Path, keep: int) -> None:
    for file in ("model.json", "model.safetensors"):
        folder = copied(saved("gp"), tmp_path / f"{file}-{keep}")
        (folder / file).write_bytes((folder / file).read_bytes()[:keep])
        if keep < len((saved("gp") / file).read_bytes()):
            with pytest.raises(ModelError, match=file.replace(".", r"\.")):
                forcegp.load_model(folder)


def test_a_flipped_bit_is_noticed(saved: Callable[[str], Path], tmp_path: Path) -> None:
    folder = copied(saved("nn"), tmp_path / "model")
    content = bytearray((folder / "model.safetensors").read_bytes())
    content[-100] ^= 1
    (folder / "model.safetensors").write_bytes(content)
    with pytest.raises(ModelError, match=r"model\.safetensors: the file is damaged"):
        forcegp.load_model(folder)


@pytest.mark.parametrize(
    ("name", "place", "value", "message"),
    [
        ("gp", "version", 99, "version 99"),
        ("gp", "version", 2, r"expected: version 3\s+got: version 2"),
        ("gp", "format", "pickle", "another format"),
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
    folder = copied(saved(name), tmp_path / "model")
    header = json.loads((folder / "model.json").read_text())
    *path, last = place.split(".")
    part = header
    for key in path:
        part = part[key]
    part[last] = value
    (folder / "model.json").write_text(json.dumps(header))
    with pytest.raises((ModelError, UnknownNameError), match=message):
        forcegp.load_model(folder)


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
    for what in ("missing", "does not fit"):
        folder = copied(saved(name), tmp_path / what)
        tensors = safetensors.torch.load_file(folder / "model.safetensors")
        if what == "missing":
            del tensors[tensor]
        else:
            tensors[tensor] = torch.ones(3, 2, dtype=torch.float64)
        content = safetensors.torch.save(tensors)
        (folder / "model.safetensors").write_bytes(content)
        header = json.loads((folder / "model.json").read_text())
        header["sha256"] = hashlib.sha256(content).hexdigest()
        (folder / "model.json").write_text(json.dumps(header))
        with pytest.raises(ModelError, match=f"'{tensor}'.*{what}"):
            forcegp.load_model(folder)


def test_no_model_is_there(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"holds no saved model(.|\n)*model\.safetensors"):
        forcegp.load_model(tmp_path)


def test_inputs_of_a_sparse_model_keep_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file does not keep the order of its tensors; kernels that read all inputs depend on theirs."""
    priors = [forcegp.JointForcePrior()]
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
