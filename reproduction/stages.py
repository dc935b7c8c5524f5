"""Stages that run once: each writes a folder with a key computed from all its inputs.

The key is a hash of the stage's name, its settings, the keys of its inputs, and the code: the sources of the
library and of the study, and the versions of the numerical libraries. A folder with a matching key is reused.
The key is written last, so an interrupted study resumes with its unfinished stages. Only one study at a time
may write to a folder.

`joblib` would not be shorter: its `Memory` pickles results, and its `Parallel` does not support dependencies,
so all workers would wait for the slowest stage of each level.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property
from graphlib import TopologicalSorter
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch

import forcegp
from forcegp.errors import DataError, ForceGPError
from forcegp.files import Header, write_text

STAGE_FILE, DATA = "stage.json", "data.json"
STUDY = Path(__file__).parent
SOURCES = (Path(str(forcegp.__file__)).parent, STUDY, STUDY.parent / "benchmarks" / "foreign_log.py")
"""Folders and files with code that affects results."""
LIBRARIES = ("torch", "numpy", "scipy", "pybullet", "mujoco")
"""Libraries with versions that are part of the keys."""
PRESENTATION = ("cli/", "report/templates/", "templates/", "page.py", "real_contact_page.py", "__main__.py")
"""Sources that only present results."""
MOST_PROCESSES = 8
"""Default limit on the number of processes, each of which holds the libraries and a log in memory."""
H = TypeVar("H", bound=Header)
Say = Callable[[str, int, int], None]
"""Called when a stage ends, with a message, the number of finished stages, and the total."""


class StageHeader(Header):
    """Header in the folder of a finished stage.

    Attributes:
        name: name of the stage.
        key: hash of all inputs of the stage.
        seconds: duration of the stage.
    """

    FORMAT: ClassVar[str] = "forcegp-stage"
    VERSION: ClassVar[int] = 1

    name: str
    key: str
    seconds: float


class StageError(ForceGPError, RuntimeError):
    """Stages that contradict each other."""


@dataclass(frozen=True)
class Stage:
    """A step of a study, finished or not.

    Attributes:
        root: folder of all stages.
        name: path of its folder below the root, such as `"fit/seed-0/gp-200"`.
        make: function of a module, called as `make(folder, *input_folders, **settings)`; writes files.
        settings: all other settings that affect the result, as JSON.
        inputs: stages that provide input files.
    """

    root: Path
    name: str
    make: Callable[..., None]
    settings: Mapping[str, Any]
    inputs: tuple[Stage, ...] = ()

    @property
    def folder(self) -> Path:
        """Output folder of the stage."""
        return self.root / self.name

    @cached_property
    def key(self) -> str:
        """Hash of everything that affects the result."""
        parts = {
            "code": [code_digest(folder) for folder in SOURCES],
            "libraries": {library: version_of(library) for library in LIBRARIES},
            "name": self.name,
            "settings": self.settings,
            "inputs": [stage.key for stage in self.inputs],
        }
        text = json.dumps(parts, sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()

    def found(self) -> StageHeader | None:
        """Return the header of the finished stage if none of its inputs has changed."""
        path = self.folder / STAGE_FILE
        try:
            header = StageHeader.from_json(path.read_bytes(), str(path), DataError)
        except (OSError, DataError):
            return None
        return header if header.key == self.key else None

    def run(self) -> float:
        """Write the files of the stage, replacing older ones.

        Returns:
                Duration [s].
        """
        began = time.perf_counter()
        # The header goes first: what is left of an interrupted removal is not taken for a finished stage.
        (self.folder / STAGE_FILE).unlink(missing_ok=True)
        if self.folder.exists():
            shutil.rmtree(self.folder)
        self.folder.mkdir(parents=True)
        self.make(self.folder, *(stage.folder for stage in self.inputs), **self.settings)
        seconds = time.perf_counter() - began
        header = StageHeader(name=self.name, key=self.key, seconds=seconds)
        write_text(self.folder / STAGE_FILE, header.to_json())
        return seconds

    def data(self, kind: type[H]) -> H:
        """Return the header written by `write_data`."""
        path = self.folder / DATA
        return kind.from_json(path.read_bytes(), str(path), DataError)


def write_data(folder: Path, data: Header) -> None:
    """Write the result of a stage as a header."""
    write_text(folder / DATA, data.to_json())


def run_stages(stages: Sequence[Stage], processes: int = 1, say: Say = lambda *_: None) -> set[str]:
    """Run unfinished stages and the stages that they depend on.

    A stage starts when its inputs are available; if several can start, the first in the list does. If a stage
        fails, running stages are completed and no further stage starts.

    Args:
            stages: the stages, by priority.
            processes: number of stages to run in parallel, each in one thread; 1 uses this process.
            say: called with a message whenever a stage ends.

        Returns:
            Names of the stages that were run.

        Raises:
            StageError: two stages have the same name.
            Exception: any exception raised by a stage.
    """
    missing = {name: stage for name, stage in _by_name(stages).items() if stage.found() is None}
    order = TopologicalSorter(
        {n: [i.name for i in s.inputs if i.name in missing] for n, s in missing.items()}
    )
    order.prepare()
    rank, ready, done = {name: i for i, name in enumerate(missing)}, [], 0
    with _start(processes) as start:
        running: dict[Future[float], str] = {}
        while order.is_active():
            ready = sorted([*ready, *order.get_ready()], key=rank.__getitem__)
            while ready and len(running) < processes:
                name = ready.pop(0)
                running[start(missing[name].run)] = name
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                name, done = running.pop(future), done + 1
                say(f"{name}: {future.result():.1f} s", done, len(missing))
                order.done(name)
    return set(missing)


def _by_name(stages: Sequence[Stage]) -> dict[str, Stage]:
    """Return the stages sorted so that each follows its dependencies."""
    found: dict[str, Stage] = {}
    for stage in stages:
        for name, other in (_by_name(stage.inputs) | {stage.name: stage}).items():
            if found.setdefault(name, other).key != other.key:
                raise StageError(f"two stages are called {name!r}, with different settings")
    return found


@contextmanager
def _start(processes: int) -> Iterator[Callable[[Callable[[], float]], Future[float]]]:
    """Yield a function that runs calls in worker processes, which an interrupt ends, or in this one."""
    if processes == 1:
        yield _at_once
        return
    others = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(processes, mp_context=context, initializer=_begin)
    try:
        yield pool.submit
    except (KeyboardInterrupt, SystemExit):
        # A worker within an operation of PyTorch would hear of the interrupt only after it.
        for worker in set(multiprocessing.active_children()) - others:
            worker.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _at_once(call: Callable[[], float]) -> Future[float]:
    done: Future[float] = Future()
    done.set_result(call())
    return done


def _begin() -> None:
    """Set up a worker with one thread that ignores interrupts and ends with its parent."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        # A killed parent cannot end its pool, and a worker would wait for work forever.
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


@cache
def code_digest(package: Path) -> str:
    """Return a hash of the sources and data files in a folder, except those that only present results.

    Args:
        package: folder of a package, or a single file.

    Returns:
        Hexadecimal SHA-256 over the relative paths and contents.
    """
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*")) or [package]:
        name = path.relative_to(package).as_posix()
        if "__pycache__" in name or name.startswith(PRESENTATION) or not path.is_file():
            continue
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        digest.update(f"{name}\0{content}\n".encode())
    return digest.hexdigest()


def version_of(package: str) -> str | None:
    """Return the installed version of a package, `None` if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def available_processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
