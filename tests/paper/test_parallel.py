"""Jobs in several processes: order, errors, and the end of workers whose parent was killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from forcegp.errors import DataError
from forcegp.paper.parallel import Job, available_processors, run_jobs


def note(folder: Path, name: str, wait_for: tuple[str, ...] = ()) -> str:
    missing = [other for other in wait_for if not (folder / other).exists()]
    (folder / name).touch()
    return ",".join(missing) or "whole"


def fail(name: str) -> None:
    raise DataError(f"{name} fails", hint="none")


def sleep_and_note(folder: Path) -> None:
    (folder / f"pid-{os.getpid()}").touch()
    time.sleep(300)


def test_a_job_starts_after_those_it_names(tmp_path: Path) -> None:
    jobs = [
        Job("last", note, (tmp_path, "last", ("a", "b", "middle")), ["middle", "b"]),
        Job("a", note, (tmp_path, "a")),
        Job("middle", note, (tmp_path, "middle", ("a",)), ["a"]),
        Job("b", note, (tmp_path, "b")),
    ]
    found = dict(run_jobs(jobs, 2))
    assert set(found) == {"last", "a", "middle", "b"} and set(found.values()) == {"whole"}


def test_an_error_of_a_job_reaches_the_caller_and_stops_what_waits(tmp_path: Path) -> None:
    jobs = [Job("bad", fail, ("bad",)), Job("after", note, (tmp_path, "after"), ["bad"])]
    with pytest.raises(DataError, match="bad fails"):
        list(run_jobs(jobs, 2))
    assert not (tmp_path / "after").exists()


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system cannot kill")
def test_workers_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    code = (
        "import sys, pathlib; sys.path.insert(0, sys.argv[2])\n"
        "from test_parallel import sleep_and_note\n"
        "from forcegp.paper.parallel import Job, run_jobs\n"
        "if __name__ == '__main__':\n"
        "    list(run_jobs([Job('a', sleep_and_note, (pathlib.Path(sys.argv[1]),))], 1))\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(code)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    parent = subprocess.Popen([sys.executable, script, tmp_path, Path(__file__).parent], env=environment)
    worker = _within(60.0, lambda: next((int(p.name[4:]) for p in tmp_path.glob("pid-*")), None))
    assert worker is not None
    parent.kill()
    parent.wait()
    assert _within(20.0, lambda: True if not _runs(worker) else None), "the worker outlived its parent"


def _within(seconds: float, look):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = look()
        if found is not None:
            return found
        time.sleep(0.05)
    return None


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")
    return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] != "Z"


def test_processors_that_may_be_used_are_counted() -> None:
    assert 1 <= available_processors() <= (os.cpu_count() or 1)
