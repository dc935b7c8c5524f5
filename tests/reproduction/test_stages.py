"""Stages run once and in order, resume after an interruption, and run again when inputs have changed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import pytest

from forcegp.errors import DataError
from reproduction import stages as module
from reproduction.stages import Stage, StageError, available_processors, code_digest, run_stages

T = TypeVar("T")
RAN = "ran.txt"
ASLEEP = 300.0
ENDED = 60.0
"""Seconds that processes get to end on a busy machine, well under those that a stage sleeps."""


def note(folder: Path, *inputs: Path, text: str = "result", fails: bool = False) -> None:
    """Write the names of the inputs that are there, and how often this was run."""
    (folder / "a.txt").write_text(text)
    with (folder.parent / f"{folder.name}-{RAN}").open("a") as file:
        file.write("x")
    if fails:
        raise DataError(f"{folder.name} fails", hint="none")
    (folder / "inputs.txt").write_text(" ".join(path.name for path in inputs if (path / "a.txt").exists()))


def sleep(folder: Path) -> None:
    (folder / f"pid-{os.getpid()}").touch()
    time.sleep(ASLEEP)


def interrupt(folder: Path, _: Path) -> None:
    (folder / "a.txt").write_text("half")
    raise KeyboardInterrupt


def stage(root: Path, name: str, *inputs: Stage, **settings: object) -> Stage:
    return Stage(root, name, note, settings, inputs)


def runs(root: Path, name: str) -> int:
    path = root / f"{name}-{RAN}"
    return len(path.read_text()) if path.exists() else 0


@pytest.mark.parametrize("processes", [1, 2])
def test_stages_run_after_those_that_they_need_and_once(tmp_path: Path, processes: int) -> None:
    first, other = stage(tmp_path, "first"), stage(tmp_path, "other")
    middle = stage(tmp_path, "middle", first)
    last = stage(tmp_path, "last", middle, other)
    said: list[tuple[str, int, int]] = []
    names = {"first", "other", "middle", "last"}
    assert run_stages([last, other], processes, lambda *line: said.append(line)) == names
    assert (last.folder / "inputs.txt").read_text() == "middle other"
    assert (middle.folder / "inputs.txt").read_text() == "first"
    assert {line.partition(": ")[0] for line, _, _ in said} == names
    assert [counts for _, *counts in said] == [[i, 4] for i in (1, 2, 3, 4)]
    assert run_stages([last, other], processes) == set()
    assert {runs(tmp_path, name) for name in names} == {1}
    header = last.found()
    assert header is not None and (header.name, header.key) == ("last", last.key)


def test_changed_settings_run_the_stage_again_and_all_that_follow(tmp_path: Path) -> None:
    for n in ("1", "1", "2"):
        one = stage(tmp_path, "one", text=n)
        run_stages([stage(tmp_path, "two", one), stage(tmp_path, "other")])
    assert [runs(tmp_path, name) for name in ("one", "two", "other")] == [2, 2, 1]
    assert (tmp_path / "one" / "a.txt").read_text() == "2"


def test_files_of_an_older_version_are_gone(tmp_path: Path) -> None:
    old = stage(tmp_path, "one")
    run_stages([old])
    (old.folder / "litter.txt").touch()
    run_stages([stage(tmp_path, "one", text="new")])
    assert sorted(path.name for path in old.folder.iterdir()) == ["a.txt", "inputs.txt", "stage.json"]


def test_an_interrupted_stage_runs_next_time_and_finished_ones_do_not(tmp_path: Path) -> None:
    one = stage(tmp_path, "one")
    with pytest.raises(KeyboardInterrupt):
        run_stages([Stage(tmp_path, "two", interrupt, {}, (one,))])
    assert run_stages([stage(tmp_path, "two", one)]) == {"two"}
    assert (tmp_path / "two" / "a.txt").read_text() == "result" and runs(tmp_path, "one") == 1


@pytest.mark.parametrize("processes", [1, 2])
def test_an_error_reaches_the_caller_and_stops_what_waits(tmp_path: Path, processes: int) -> None:
    bad = stage(tmp_path, "bad", fails=True)
    with pytest.raises(DataError, match="bad fails"):
        run_stages([stage(tmp_path, "after", bad)], processes)
    assert not (tmp_path / "after").exists() and bad.found() is None


@pytest.mark.parametrize("damage", ["{", "", '{"format": "forcegp-stage", "version": 99}'])
def test_a_damaged_stage_is_run_again(tmp_path: Path, damage: str) -> None:
    one = stage(tmp_path, "one")
    run_stages([one])
    (one.folder / "stage.json").write_text(damage)
    assert run_stages([one]) == {"one"}


def test_the_key_tells_name_and_settings_apart_but_not_their_order(tmp_path: Path) -> None:
    assert stage(tmp_path, "a", x=1, y=2).key == stage(tmp_path, "a", y=2, x=1).key
    assert len({stage(tmp_path, name, x=x).key for name in "ab" for x in (1, 1.5, "1", None)}) == 8


def test_one_name_with_two_meanings_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="two stages are called 'one'"):
        run_stages([stage(tmp_path, "one"), stage(tmp_path, "two", stage(tmp_path, "one", text="other"))])
    assert not list(tmp_path.iterdir())


def package(root: Path, text: str = "x = 1") -> Path:
    """A package with a module, a template and a command."""
    for name, content in (("a.py", text), ("cli/b.py", "y = 2"), ("__pycache__/a.pyc", "z")):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(content)
    return root


def test_the_digest_follows_the_sources_but_not_caches_and_commands(tmp_path: Path) -> None:
    digests = [code_digest(package(tmp_path / name)) for name in "ab"]
    assert digests[0] == digests[1]
    assert code_digest(package(tmp_path / "c", "x = 2")) != digests[0]
    for ignored in ("cli/b.py", "__pycache__/a.pyc"):
        changed = package(tmp_path / ignored.replace("/", "-"))
        (changed / ignored).write_text("changed")
        assert code_digest(changed) == digests[0]
    renamed = package(tmp_path / "d")
    (renamed / "a.py").rename(renamed / "e.py")
    assert code_digest(renamed) != digests[0]


def test_results_of_other_code_are_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for text, expected in (("x = 1", {"one"}), ("x = 1", set()), ("x = 2", {"one"})):
        monkeypatch.setattr(module, "SOURCES", (package(tmp_path / text.replace(" ", ""), text),))
        assert run_stages([stage(tmp_path / "out", "one")]) == expected


@pytest.fixture
def study(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[bytes], list[int]]]:
    """A process that runs two stages that sleep, and its two workers."""
    script = tmp_path / "study.py"
    script.write_text(
        "import pathlib, signal, sys\n"
        "from test_stages import sleep\n"
        "from reproduction.stages import Stage, run_stages\n"
        "if __name__ == '__main__':\n"
        # Background jobs of a shell start with SIGINT ignored, and so do their children.
        "    signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "    root = pathlib.Path(sys.argv[1])\n"
        "    try:\n"
        "        run_stages([Stage(root, name, sleep, {}) for name in 'ab'], 2)\n"
        "    except KeyboardInterrupt:\n"
        "        sys.exit(130)\n"
    )
    here = Path(__file__).parent
    paths = os.pathsep.join([str(here), str(here.parents[1]), *sys.path])
    parent = subprocess.Popen([sys.executable, script, tmp_path], env=os.environ | {"PYTHONPATH": paths})
    found = _within(60.0, lambda: pids if len(pids := list(tmp_path.glob("?/pid-*"))) == 2 else None)
    assert found is not None
    workers = [int(path.name[4:]) for path in found]
    yield parent, workers
    for process in (parent.pid, *workers):
        if _exists(process):
            os.kill(process, signal.SIGKILL)


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_an_interrupt_ends_a_study_and_its_workers(study: tuple[subprocess.Popen[bytes], list[int]]) -> None:
    parent, workers = study
    parent.send_signal(signal.SIGINT)
    assert parent.wait(ENDED) == 130
    assert not any(map(_exists, workers))


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_workers_end_when_their_parent_is_killed(study: tuple[subprocess.Popen[bytes], list[int]]) -> None:
    parent, workers = study
    parent.kill()
    parent.wait()
    assert _within(ENDED, lambda: None if any(map(_exists, workers)) else True), (
        "a worker outlived its parent"
    )


def _within(seconds: float, look: Callable[[], T | None]) -> T | None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = look()
        if found is not None:
            return found
        time.sleep(0.05)
    return None


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")
    return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] != "Z"


def test_processors_that_may_be_used_are_counted() -> None:
    assert 1 <= available_processors() <= (os.cpu_count() or 1)
