"""Odd paths, robots and saved models end in one typed error, or work; never in an error of the system."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import forcegp
from forcegp.errors import ForceGPError, NumericalError, ParameterError
from forcegp.logs.readers import read
from model_files import rewritten
from random_data import random_data, table_system

SYSTEM = table_system()
DATA = random_data(SYSTEM, 8)
FIT = forcegp.AnalyticalModel(SYSTEM).nominal()
READERS: dict[str, tuple[str, Callable[[str], object]]] = {
    "data set": (".parquet", forcegp.Dataset.read),
    "log": (".csv", read),
    "scene": (".toml", forcegp.load_scene),
    "robot": (".urdf", forcegp.load_robot),
    "model": (".safetensors", forcegp.load_model),
}
WRITERS: dict[str, Callable[[str], object]] = {
    "data set": lambda path: DATA.write(path + ".parquet"),
    "model": FIT.save,
}
NAMES = st.sampled_from(
    ("", ".", "..", "/", "~nobody", "~", "loop", "file", "file/x", "a" * 300, "a\0b", "é" * 150)
)


@settings(max_examples=150, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(parts=st.lists(NAMES, min_size=1, max_size=3), relative=st.booleans(), ending=st.booleans())
def test_any_path_is_read_or_refused(parts: list[str], relative: bool, ending: bool) -> None:
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path("loop").symlink_to("loop")
        Path("file").write_text("text")
        name = "/".join(parts) if relative else f"{folder}/" + "/".join(parts)
        for suffix, reader in READERS.values():
            with pytest.raises(ForceGPError):
                reader(name + suffix if ending else f"{name}/none{suffix}")
        for writer in WRITERS.values():
            if ".." not in parts and not name.startswith("/" * 2) and parts[0] != "/":
                with_typed_errors(lambda writer=writer: writer(f"{name}/out"))


def with_typed_errors(call: Callable[[], object]) -> None:
    with contextlib.suppress(ForceGPError):
        call()


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    FIT.save(path)
    return path


VALUES = st.sampled_from(
    (None, True, 0, -1, 10**400, 1e308, "", "é", [], {}, [[0]], -(2**63), "qdd", [1e9, -1])
)


@settings(max_examples=120, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(choices=st.lists(st.integers(0, 10**6), min_size=1, max_size=2), value=VALUES)
def test_a_model_with_a_right_hash_and_strange_content_is_read_or_refused(
    choices: list[int], value: object, model: Path
) -> None:
    def change(header: dict, tensors: dict[str, torch.Tensor]) -> None:
        places = [(header, key) for key in header]
        for holder, key in places:
            inner = holder[key]
            if isinstance(inner, dict | list) and inner:
                places += [(inner, k) for k in (inner if isinstance(inner, dict) else range(len(inner)))]
        for choice in choices:
            holder, key = places[choice % len(places)]
            holder[key] = value
        name = sorted(tensors)[choices[0] % len(tensors)]
        if choices[0] % 3 == 0:
            tensors[name] = tensors[name].flatten()[:1].clone()

    with tempfile.TemporaryDirectory() as folder:
        try:
            loaded = forcegp.load_model(rewritten(model, Path(folder) / "changed.safetensors", change))
            loaded.predict(DATA.q, DATA.qd, DATA.tau)
        except ForceGPError:
            return


def test_robots_that_cannot_be_are_refused() -> None:
    robot = SYSTEM.robot
    for field in ("gravity", "mass"):
        for value in (float("nan"), float("inf")):
            with pytest.raises(ParameterError, match=f"'{field}' is not finite"):
                robot.replace(**{field: torch.full_like(getattr(robot, field), value)})
    light = robot.replace(mass=-robot.mass)
    with pytest.raises(NumericalError, match="mass matrix is not positive definite"):
        forcegp.dynamics.forward_dynamics(light, DATA.q, DATA.qd, DATA.tau)
    with pytest.raises(NumericalError, match="mass matrix is not positive definite"):
        forcegp.ConstrainedSystem(light, SYSTEM.contacts).equations(DATA.q, DATA.qd).M_cholesky  # noqa: B018


FULL = """
import resource, sys
import forcegp
from forcegp.errors import DestinationError
fit, data = forcegp.load_model(sys.argv[1]), forcegp.Dataset.read(sys.argv[2])
resource.setrlimit(resource.RLIMIT_FSIZE, (500, 500))
for write in (lambda: fit.save(sys.argv[3]), lambda: data.write(sys.argv[3] + ".parquet")):
    try:
        write()
    except DestinationError:
        print("refused")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits of POSIX")
def test_a_limit_on_the_size_of_files_is_a_destination_error(model: Path, tmp_path: Path) -> None:
    DATA.write(tmp_path / "data.parquet")
    command = [sys.executable, "-c", FULL, str(model), str(tmp_path / "data.parquet"), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split()[-2:] == ["refused", "refused"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data.parquet"]
