"""Model files whose hashes were repaired after a change: every one is read in full or refused by name."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import safetensors
import safetensors.torch
import torch

import forcegp
from forcegp.destination import check_destination
from forcegp.errors import DestinationError, ForceGPError, ModelError
from forcegp.forces.priors.sets import friction_priors
from forcegp.storage import model_file as module
from forcegp.storage.model_file import HEADER, model_path
from model_files import header_of, rewritten
from random_data import random_data, table_system
from slow import slow_except

SYSTEM = table_system()
DATA = random_data(SYSTEM, 8)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One file of each kind of models, conditioned or trained for a moment."""
    from forcegp.gp.optimise import LearningOptions
    from forcegp.models.minibatch import BatchOptions
    from forcegp.models.registry import create

    root, found = tmp_path_factory.mktemp("models"), {}
    sparse = forcegp.StructuredGP(
        SYSTEM,
        "analytical",
        friction_priors(SYSTEM),
        0.1,
        inference=forcegp.models.Inference("sparse", inducing_points=6),
    )
    sparse.fit(random_data(SYSTEM, 40), options=LearningOptions(max_evaluations=1)).save(root / "sparse")
    found["sparse"] = model_path(root / "sparse")
    for name in ("nn", "gp", "sgp-mean"):
        model = create(name, SYSTEM, noise=0.1, seed=2)
        options = BatchOptions(epochs=1) if name == "nn" else LearningOptions(max_evaluations=1)
        model = model.fit(DATA, options=options)  # type: ignore[call-arg]
        model.save(root / name)
        found[name] = model_path(root / name)
    return found


def repaired(source: Path, target: Path, tensors: dict | None = None, **fields: object) -> Path:
    """A copy with other tensors or header fields, and the hash that belongs to them."""

    def change(header: dict, own: dict[str, torch.Tensor]) -> None:
        own.update(tensors or {})
        for place, value in fields.items():
            *path, last = place.split("__")
            inner = header
            for key in path:
                inner = inner[key]
            inner[last] = value

    return rewritten(source, target, change)


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


@pytest.mark.parametrize("name", slow_except(["nn", "gp", "sgp-mean"], "nn"))
def test_a_changed_tensor_is_refused_or_predicts_finite_numbers(
    name: str, saved: dict[str, Path], tmp_path: Path
) -> None:
    tensors = safetensors.torch.load_file(saved[name])
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


def reshaped(value: torch.Tensor) -> dict[str, torch.Tensor | None]:
    """The same numbers in other shapes and types, and a missing tensor."""
    found: dict[str, torch.Tensor | None] = {
        "missing": None,
        "row": torch.cat([value.flatten(), value.flatten()]),
    }
    if value.is_floating_point():
        found["single"] = value.float()
    if value.ndim:
        found |= {"less": value[:-1], "column": value[..., None]}
    if value.ndim > 1:
        found |= {"transposed": value.mT, "flat": value.flatten(), "narrow": value[..., :-1]}
        found["wide"] = torch.cat([value, value[..., :1]], dim=-1)
    return found


@pytest.mark.parametrize("name", ["sgp-mean", "sparse"])
def test_tensors_that_contradict_each_other_are_refused_when_they_are_read(
    name: str, saved: dict[str, Path], tmp_path: Path
) -> None:
    """Every tensor of the forces in every other shape; what is read predicts without a raw error."""
    tensors = safetensors.torch.load_file(saved[name])
    refused, read = 0, 0
    for key in (key for key in tensors if not key.startswith(("system.", "start."))):
        for kind, changed in reshaped(tensors[key]).items():

            def change(header: dict, own: dict[str, torch.Tensor]) -> None:
                del own[key]  # noqa: B023
                if changed is not None:  # noqa: B023
                    own[key] = changed.contiguous()  # noqa: B023

            place = rewritten(saved[name], tmp_path / "model", change)
            try:
                model = forcegp.load_model(place)
            except ForceGPError:
                refused += 1
                continue
            read += 1
            for active in (None, torch.zeros(len(DATA), 1, dtype=torch.bool)):
                try:
                    model.predict(DATA.q, DATA.qd, DATA.tau, active=active)
                except ForceGPError:
                    pass
                except Exception as error:
                    pytest.fail(f"{key} {kind}: {error!r}")
    assert refused > 2 * read > 0


@pytest.mark.parametrize("tensor", ["data.0.noise_std", "training.noise_std", "std.q"])
def test_a_standard_deviation_that_is_not_positive_is_named(
    tensor: str, saved: dict[str, Path], tmp_path: Path
) -> None:
    name = {"data.0.noise_std": "sgp-mean", "training.noise_std": "gp", "std.q": "nn"}[tensor]
    value = safetensors.torch.load_file(saved[name])[tensor]
    for number, wrong in enumerate((-0.1, 0.0)):
        value = value.clone()
        value[0] = wrong
        place = repaired(saved[name], tmp_path / str(number), {tensor: value})
        with pytest.raises(
            ModelError, match=rf"'{tensor}' contains a standard deviation that is not positive"
        ):
            forcegp.load_model(place)


def test_a_negative_noise_in_the_settings_is_refused(saved: dict[str, Path], tmp_path: Path) -> None:
    place = repaired(saved["sgp-mean"], tmp_path / "a", settings__noise__acceleration=-0.1)
    with pytest.raises(ModelError, match=r"noise\.acceleration"):
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
    priors = header_of(saved["sgp-mean"])["settings"]["priors"]
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
    (tmp_path / "a.safetensors").mkdir()
    with pytest.raises(ModelError, match="is not a saved model"):
        forcegp.load_model(tmp_path / "a")
    monkeypatch.setattr(module, "MODEL_BYTES", 1000)
    with pytest.raises(ModelError, match=r"gp\.safetensors: too large"):
        forcegp.load_model(saved["gp"])


def test_every_flipped_bit_is_noticed(saved: dict[str, Path], tmp_path: Path) -> None:
    """In the length, the header, the hash and the tensors alike."""
    content = bytearray(saved["sgp-mean"].read_bytes())
    damaged = tmp_path / "damaged.safetensors"
    step = max(1, len(content) // 400)
    for at in [*range(8), *range(8, len(content), step)]:
        content[at] ^= 1 << (at % 8)
        damaged.write_bytes(content)
        with pytest.raises(ModelError):
            forcegp.load_model(damaged)
        content[at] ^= 1 << (at % 8)
    damaged.write_bytes(content)
    forcegp.load_model(damaged)


@pytest.mark.parametrize("stated", ["", "0" * 64, "\ud800" * 64, '"' * 64])
def test_a_hash_that_is_none_is_refused(stated: str, tmp_path: Path) -> None:
    text = json.dumps({"__metadata__": {HEADER: f"{stated}\n{{}}"}}).encode()
    (tmp_path / "model.safetensors").write_bytes(len(text).to_bytes(8, "little") + text)
    with pytest.raises(ModelError, match="damaged or truncated"):
        forcegp.load_model(tmp_path / "model")


def test_a_reader_beside_a_writer_sees_the_old_model_or_the_new_one(
    saved: dict[str, Path], tmp_path: Path
) -> None:
    models = [forcegp.load_model(saved[name]) for name in ("nn", "gp")]
    models[0].save(tmp_path / "model")
    done = threading.Event()

    def write() -> None:
        for turn in range(60):
            models[turn % 2].save(tmp_path / "model")
        done.set()

    writer = threading.Thread(target=write)
    writer.start()
    kinds = set()
    while not done.is_set():
        kinds.add(forcegp.load_model(tmp_path / "model").kind)
    writer.join()
    assert kinds <= {models[0].kind, models[1].kind}


def test_a_folder_of_an_earlier_release_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    with pytest.raises(ModelError, match="folders before version 3"):
        forcegp.load_model(tmp_path / "model")


def test_the_destination_of_a_model_is_checked_before_the_work(
    saved: dict[str, Path], tmp_path: Path
) -> None:
    check_destination(model_path(tmp_path / "new"))
    check_destination(model_path(saved["gp"]))
    (tmp_path / "thesis").write_text("years of work")
    with pytest.raises(DestinationError, match="cannot be written"):
        check_destination(model_path(tmp_path / "thesis" / "model"))
    (tmp_path / "folder.safetensors").mkdir()
    with pytest.raises(DestinationError, match="is a folder"):
        check_destination(model_path(tmp_path / "folder"))
