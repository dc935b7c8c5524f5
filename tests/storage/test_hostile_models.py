"""Model folders whose hashes were repaired after a change: every one is read in full or refused by name."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
import safetensors
import safetensors.torch
import torch

import forcegp
from forcegp.errors import DestinationError, ForceGPError, ModelError
from forcegp.storage import folder as module
from forcegp.storage.model_file import HEADER_FILE, TENSOR_FILE, check_model_destination
from forcegp.temporary import ASIDE
from random_data import random_data, table_system

SYSTEM = table_system()
DATA = random_data(SYSTEM, 8)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One folder of each kind of models, conditioned or trained for a moment."""
    from forcegp.gp.optimise import LearningOptions
    from forcegp.models.minibatch import BatchOptions
    from forcegp.models.registry import create

    root, found = tmp_path_factory.mktemp("models"), {}
    for name in ("nn", "gp", "sgp-mean"):
        model = create(name, SYSTEM, noise=0.1, seed=2)
        options = BatchOptions(epochs=1) if name == "nn" else LearningOptions(max_evaluations=1)
        model = model.fit(DATA, options=options)  # type: ignore[call-arg]
        model.save(root / name)
        found[name] = root / name
    return found


def repaired(source: Path, target: Path, tensors: dict | None = None, **fields: object) -> Path:
    """A copy with other tensors or header fields, and the hash that belongs to them."""
    target.mkdir()
    header = json.loads((source / HEADER_FILE).read_text())
    found = safetensors.torch.load_file(source / TENSOR_FILE)
    content = safetensors.torch.save(found | (tensors or {}))
    (target / TENSOR_FILE).write_bytes(content)
    header["sha256"] = hashlib.sha256(content).hexdigest()
    for place, value in fields.items():
        part, *path = place.split("__")
        inner = header
        for key in (part, *path)[:-1]:
            inner = inner[key]
        inner[(part, *path)[-1]] = value
    (target / HEADER_FILE).write_text(json.dumps(header))
    return target


def changes(value: torch.Tensor) -> dict[str, torch.Tensor]:
    ones = torch.ones(value.shape, dtype=torch.float64)
    found = {
        "nan": ones * float("nan"),
        "infinite": ones * float("inf"),
        "complex": ones.to(torch.complex64),
        "half": ones.half(),
        "empty": ones.flatten()[:0],
        "scalar": torch.tensor(1.0, dtype=torch.float64),
        "int": ones.long(),
        "negative": -ones,
        "huge": ones * 1e300,
    }
    try:
        safetensors.torch.save({"a": found["complex"]})
    except (KeyError, ValueError, safetensors.SafetensorError):  # older releases know no complex numbers
        del found["complex"]
    return found


@pytest.mark.parametrize("name", ["nn", "gp", "sgp-mean"])
def test_a_changed_tensor_is_refused_or_predicts_finite_numbers(
    name: str, saved: dict[str, Path], tmp_path: Path
) -> None:
    tensors = safetensors.torch.load_file(saved[name] / TENSOR_FILE)
    refused, answered = 0, 0
    for number, (key, value) in enumerate(tensors.items()):
        for kind, changed in changes(value).items():
            place = repaired(saved[name], tmp_path / f"{number}-{kind}", {key: changed})
            message, prediction = None, None
            try:
                model = forcegp.load_model(place)
                prediction = model.predict(DATA.q, DATA.qd, DATA.tau)
            except ForceGPError as error:
                message = str(error)
            if kind in ("nan", "complex", "half"):
                assert message is not None and key in message, f"{key} {kind}: {message}"
            if prediction is not None:
                assert bool(torch.isfinite(prediction.mean).all()), f"{key} {kind}: silent NaN"
            refused, answered = refused + (prediction is None), answered + (prediction is not None)
    assert refused > 5 * len(tensors) and answered > 0


@pytest.mark.parametrize("tensor", ["data.0.noise_std", "training.noise_std", "std.q"])
def test_a_standard_deviation_that_is_not_positive_is_named(
    tensor: str, saved: dict[str, Path], tmp_path: Path
) -> None:
    name = {"data.0.noise_std": "sgp-mean", "training.noise_std": "gp", "std.q": "nn"}[tensor]
    value = safetensors.torch.load_file(saved[name] / TENSOR_FILE)[tensor]
    for number, wrong in enumerate((-0.1, 0.0)):
        value = value.clone()
        value[0] = wrong
        place = repaired(saved[name], tmp_path / str(number), {tensor: value})
        with pytest.raises(ModelError, match=rf"'{tensor}' holds a standard deviation that is not positive"):
            forcegp.load_model(place)


def test_a_negative_noise_in_the_settings_is_refused(saved: dict[str, Path], tmp_path: Path) -> None:
    place = repaired(saved["sgp-mean"], tmp_path / "a", settings__noise_std=-0.1)
    with pytest.raises(ModelError, match="noise_std"):
        forcegp.load_model(place)


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="peak memory is read from /proc")
def test_a_network_of_billions_of_weights_is_refused_before_it_is_allocated(
    saved: dict[str, Path], tmp_path: Path
) -> None:
    """40,000 × 40,000 float64 would be 12 GiB."""
    place = repaired(saved["nn"], tmp_path / "a", settings__hidden=[40_000, 40_000])
    code = (
        "import re, forcegp\nfrom pathlib import Path\nfrom forcegp.errors import ModelError\n"
        f"try:\n    forcegp.load_model({str(place)!r})\n"
        "except ModelError as error:\n    print('does not fit' in str(error))\n"
        # Not ru_maxrss: a child inherits that of the process that started it.
        "peak = re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())\n"
        "print(int(peak[1]) < 1 << 20)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "True"], done.stderr


def test_kernels_inside_kernels_without_end_are_refused(saved: dict[str, Path], tmp_path: Path) -> None:
    header = json.loads((saved["sgp-mean"] / HEADER_FILE).read_text())
    priors = header["settings"]["priors"]
    leaf = {"type": "linear", "inputs": None}
    for _ in range(300):
        leaf = {"type": "sum", "left": leaf, "right": {"type": "linear", "inputs": None}}
    priors[0]["kernel"] = leaf
    place = repaired(saved["sgp-mean"], tmp_path / "a", settings__priors=priors)
    start = time.perf_counter()
    with pytest.raises(ModelError, match="nested too deeply"):
        forcegp.load_model(place)
    assert time.perf_counter() - start < 5.0


def test_a_folder_for_a_file_and_too_large_a_file_are_refused(
    saved: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = repaired(saved["gp"], tmp_path / "a")
    (place / TENSOR_FILE).unlink()
    (place / TENSOR_FILE).mkdir()
    with pytest.raises(ModelError, match="holds no saved model"):
        forcegp.load_model(place)
    monkeypatch.setattr(module, "MODEL_BYTES", 1000)
    with pytest.raises(ModelError, match=r"model\.safetensors: too large"):
        forcegp.load_model(saved["gp"])


def test_a_model_moved_aside_by_a_dead_writer_is_found(saved: dict[str, Path], tmp_path: Path) -> None:
    place = repaired(saved["nn"], tmp_path / "model")
    place.rename(tmp_path / f"{ASIDE}0123456789ab-model")
    forcegp.load_model(place)


def test_the_destination_of_a_model_is_checked_before_the_work(
    saved: dict[str, Path], tmp_path: Path
) -> None:
    check_model_destination(tmp_path / "new")
    check_model_destination(saved["gp"])
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(DestinationError, match=r"thesis\.tex"):
        check_model_destination(tmp_path)
    with pytest.raises(DestinationError, match="is a file"):
        check_model_destination(tmp_path / "thesis.tex")
