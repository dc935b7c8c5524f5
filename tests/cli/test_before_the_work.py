"""What a command asks before its work: whether its result can be written, and whether memory is enough."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from faults.commands import prepare
from forcegp import resources
from forcegp.cli import app
from forcegp.data import Dataset
from forcegp.errors import DataError, DestinationError, ForceGPError, MemoryLimitError
from forcegp.gp import exact
from forcegp.resources import MemoryNeedWarning
from reproduction.__main__ import app as study
from slow import slow_except

PLENTY = 1 << 60


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    prepare(folder)
    return folder


def run(*arguments: object) -> None:
    program, given = (study, arguments[1:]) if arguments[0] == "reproduce" else (app, arguments)
    done = CliRunner().invoke(program, [str(argument) for argument in given])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception


def arguments(command: str, made: Path, out: Path) -> list[object]:
    """A command on the small inputs, without its destination."""
    scene, log, model = made / "scene.toml", made / "run.parquet", made / "model"
    return {
        "simulate": ["simulate", "-s", scene, "-o", out],
        "import": ["import", made / "log.csv", "-s", scene, "-m", made / "mapping.toml", "-o", out],
        "guess": ["import", made / "log.csv", "-s", scene, "--guess", out],
        "check": ["check", "-s", scene, "-d", log, "-o", out],
        "select": ["select", log, "-n", 5, "-o", out],
        "select --rest": ["select", log, "-n", 5, "-o", made / "x.parquet", "--rest", out],
        "fit": ["fit", "-s", scene, "-d", made / "train.parquet", "-m", "sgp-zero", "-o", out],
        "fit gp": ["fit", "-s", scene, "-d", made / "train.parquet", "-m", "gp", "-o", out],
        "predict": ["predict", "-m", model, "-d", log, "-o", out],
        "evaluate": ["evaluate", "-m", model, "-d", log, "-o", out],
        "rollout": ["rollout", "-m", model, "-d", log, "-o", out],
        "reproduce": ["reproduce", "-o", out],
    }[command]


COMMANDS = (
    *("simulate", "import", "guess", "check", "select", "select --rest", "fit"),
    *("predict", "evaluate", "rollout", "reproduce"),
)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_place_that_cannot_be_written_is_refused_before_anything_is_read(
    command: str, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read(*_: Any, **__: Any) -> None:
        raise AssertionError("the work has begun")

    monkeypatch.setattr("forcegp.scene.load.Document", read)
    monkeypatch.setattr(Dataset, "read", read)
    monkeypatch.setattr("forcegp.checks.read_log", read)
    monkeypatch.setattr("forcegp.load_model", read)
    monkeypatch.setattr("forcegp.logs.import_log", read)
    monkeypatch.setattr("forcegp.logs.guess.guess_mapping", read)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DestinationError, match="cannot be written"):
        run(*arguments(command, made, tmp_path / "file" / "result.parquet"))


@pytest.mark.parametrize("command", ["import", "guess", "check", "select", "predict"])
def test_a_result_is_not_written_over_what_it_is_made_from(command: str, made: Path, tmp_path: Path) -> None:
    log = made / ("log.csv" if command == "guess" else "run.parquet")
    inputs = [log if x == made / "log.csv" else x for x in arguments(command, made, log)]
    before = log.read_bytes()
    with pytest.raises(DestinationError, match="would be overwritten"):
        run(*inputs)
    assert log.read_bytes() == before


def test_both_parts_of_a_selection_are_not_one_file(made: Path, tmp_path: Path) -> None:
    out = tmp_path / "part.parquet"
    with pytest.raises(DestinationError, match="would be overwritten"):
        run("select", made / "run.parquet", "-n", 5, "-o", out, "--rest", tmp_path / "." / "part.parquet")


@pytest.mark.parametrize("command", ["simulate", "select", "select --rest", "predict"])
def test_another_ending_than_parquet_is_refused_before_the_work(
    command: str, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Dataset, "read", None)
    monkeypatch.setattr("forcegp.scene.load.Document", None)
    with pytest.raises(DataError, match="written as Parquet"):
        run(*arguments(command, made, tmp_path / "result.csv"))


@pytest.mark.parametrize(
    "command",
    slow_except(
        ["simulate", "select", "predict", "evaluate", "rollout", "check", "guess"],
        *("simulate", "select", "predict", "guess"),
    ),
)
def test_a_result_whose_place_fails_later_is_kept(
    command: str, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, spare = tmp_path / "results", tmp_path / "spare"
    place.mkdir()
    spare.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(spare))
    fails_in(place, monkeypatch)
    with pytest.raises(DestinationError, match="it was saved to"):
        run(*arguments(command, made, place / "result.parquet"))
    [kept] = spare.iterdir()
    assert (kept / "result.parquet").exists()


def fails_in(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nothing be written below a folder, which was fine when it was tested."""
    from forcegp import files

    make: Callable[..., Any] = files.Temporary

    def refuse(target: Path, **options: Any) -> Any:
        if target.is_relative_to(place):
            raise OSError(28, "No space left on device")
        return make(target, **options)

    monkeypatch.setattr(files, "Temporary", refuse)


WORK = {
    "simulate": "a simulation of 36 steps",
    "import": "reading .*log.csv|importing 36 rows",
    "check": "reading .*run.parquet|checking 36 rows",
    "select": "reading .*run.parquet",
    "fit": "a fit to 6 samples|exact inference on 6 samples",
    "fit gp": "independent Gaussian processes on 6 samples",
    "predict": "reading .*run.parquet|exact inference on 3 samples",
    "evaluate": "an evaluation on 36 samples|exact inference on 3 samples",
    "rollout": "1 trajectories of 35 steps",
    "reproduce": "the largest fit, to 200 samples,",
}


def said(command: str, made: Path, tmp_path: Path) -> list[str]:
    """What a command says about memory."""
    with pytest.warns(MemoryNeedWarning) as record:
        run(*arguments(command, made, tmp_path / "result.parquet"))
    return [str(w.message) for w in record if issubclass(w.category, MemoryNeedWarning)]


@pytest.mark.parametrize("command", [name for name in WORK if name != "reproduce"])
def test_work_that_takes_most_of_the_memory_is_announced(
    command: str, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resources, "LARGE", 0.0)
    for module in (resources, exact):
        monkeypatch.setattr(module, "free_memory", lambda: PLENTY)
    sentences = " ".join(said(command, made, tmp_path))
    for sentence in WORK[command].split("|"):
        assert re.search(sentence + r"( \(\d+ rows\))? needs ", sentences), sentences


@pytest.mark.parametrize("command", WORK)
def test_work_that_cannot_fit_is_refused(
    command: str, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (resources, exact):
        monkeypatch.setattr(module, "free_memory", lambda: 1)
    if command != "select":
        monkeypatch.setattr("forcegp.data.table.announce_memory", lambda *_, **__: None)
    with pytest.raises(ForceGPError, match=r"more memory than is free|does not fit into memory") as error:
        run(*arguments(command, made, tmp_path / "result.parquet"))
    assert isinstance(error.value, MemoryLimitError) or "exact inference" in error.value.message
    assert not (tmp_path / "result.parquet").exists()


def test_a_simulation_of_years_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MemoryLimitError, match=r"a simulation of [\d,]+ steps needs more memory"):
        run("simulate", "-s", "kuka_plane", "--duration", 1e9, "-o", tmp_path / "run.parquet")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="peak memory is read from /proc")
def test_the_bound_on_the_equations_of_motion_is_one() -> None:
    """Their peak, in a process of its own, is below the bound and not far below it."""
    script = """
import re, torch, forcegp
from pathlib import Path
from forcegp.constraints.system import CERTAIN
system = forcegp.load_scene("kuka_plane").system()
def peak(): return 1024 * int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
def work(n):
    q = torch.zeros(n, 7, dtype=torch.float64)
    eom = system.equations(q, q)
    eom.H, eom.acceleration(eom.Q_C)
work(10)
before = peak()
work(20_000)
print((peak() - before) / 20_000 / system.state_bytes, CERTAIN)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    share, certain = map(float, done.stdout.split())
    assert certain < share < 1.0
