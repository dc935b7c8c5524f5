"""Stages that run once: each leaves a folder with the key of everything that went into it.

The key is a hash of the stage's name, its settings, the keys of its inputs, and the code: the sources of
the package and the versions of the libraries that compute. A folder whose key still matches is used as it
is. A folder appears whole or not at all, so an interrupted run resumes with the first unfinished stage.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import ClassVar, Protocol, TypeVar, runtime_checkable

from forcegp.errors import DataError, ForceGPError
from forcegp.exchange import recover
from forcegp.files import Header, atomic_directory, write_text

STAGE_FILE, DATA = "stage.json", "data.json"
PACKAGE = Path(__file__).parents[1]
"""Folder of the library."""
LIBRARIES = ("torch", "numpy", "scipy", "pybullet", "mujoco")
"""Libraries whose versions go into the keys."""
PRESENTATION = (
    "cli/",
    "report/templates/",
    "paper/page.py",
    "paper/real_contact_page.py",
    "paper/templates/",
)
"""Sources that only show what stages have computed."""
H = TypeVar("H", bound=Header)


@runtime_checkable
class Advance(Protocol):
    """Moves a progress bar; `note` is a short remark, such as the objective."""

    def __call__(self, done: int, total: int | None = None, note: str = "") -> None: ...


Progress = Callable[[str, int], AbstractContextManager[Advance]]
"""Opens a progress bar with a description and a total."""


def silent(description: str, total: int) -> AbstractContextManager[Advance]:
    """A progress bar that shows nothing."""

    def advance(done: int, total: int | None = None, note: str = "") -> None:
        pass

    return nullcontext(advance)


class StageHeader(Header):
    """Header of a stage's folder.

    Attributes:
        name: of the stage.
        key: hash of everything that went into it.
        seconds: how long it took.
    """

    FORMAT: ClassVar[str] = "forcegp-stage"
    VERSION: ClassVar[int] = 1

    name: str
    key: str
    seconds: float


class StageError(ForceGPError, RuntimeError):
    """A stage that cannot be run as asked."""


@dataclass(frozen=True)
class Stage:
    """A stage that is done.

    Attributes:
        folder: where its files are.
        key: of everything that went into it.
        seconds: how long it took when it was run.
        reused: whether an earlier result was used.
    """

    folder: Path
    key: str
    seconds: float
    reused: bool

    def __truediv__(self, name: str) -> Path:
        """The path of one of its files."""
        return self.folder / name


class Stages:
    """Runs stages under one folder.

    Args:
        root: where the stages' folders go.
        progress: opens a progress bar.
        say: called with one line for every stage that ends.
        made: names of stages that other processes have just run, which do not count as reused.
    """

    def __init__(
        self,
        root: Path,
        progress: Progress = silent,
        say: Callable[[str], None] = lambda _: None,
        made: Collection[str] = (),
    ) -> None:
        self.root, self.progress, self.say, self.made = root, progress, say, made
        self.done: dict[str, Stage] = {}

    def run(
        self,
        name: str,
        make: Callable[[Path, Advance], None],
        *,
        settings: Mapping[str, object],
        inputs: Sequence[Stage] = (),
        total: int = 1,
    ) -> Stage:
        """Run a stage unless it is done and nothing that went into it has changed.

        Args:
            name: a path below the root, such as `"fit/seed-0/gp-200"`.
            make: writes the stage's files into the folder it is given, and may report progress.
            settings: everything besides inputs and code that decides the result; must be JSON.
            inputs: stages whose files are read.
            total: steps of the progress bar.

        Raises:
            StageError: the same name was run before with other settings.
        """
        key = stage_key(name, settings, inputs)
        folder = self.root / name
        stage = _found(folder, key, reused=name not in self.made)
        if stage is None:
            began = time.perf_counter()
            with self.progress(name, total) as advance, atomic_directory(folder) as temporary:
                make(temporary, advance)
                seconds = time.perf_counter() - began
                header = StageHeader(name=name, key=key, seconds=seconds)
                write_text(temporary / STAGE_FILE, header.to_json())
            stage = Stage(folder, key, seconds, reused=False)
            self.say(f"{name}: {seconds:.1f} s")
        if self.done.get(name, stage).key != key:
            raise StageError(f"the stage {name!r} was requested twice, with different settings")
        self.done[name] = stage
        return stage

    def data(
        self,
        name: str,
        kind: type[H],
        make: Callable[[Advance], H],
        *,
        settings: Mapping[str, object],
        inputs: Sequence[Stage] = (),
    ) -> H:
        """Run a stage that computes one header, unless it is done; see `run`.

        Args:
            name: a path below the root.
            kind: class of the header.
            make: computes it, and may report progress.
            settings, inputs: as for `run`.

        Returns:
            The header, read from the stage's folder.
        """

        def write(folder: Path, advance: Advance) -> None:
            write_text(folder / DATA, make(advance).to_json())

        path = self.run(name, write, settings=settings, inputs=inputs) / DATA
        return kind.from_json(path.read_bytes(), str(path), DataError)

    @property
    def seconds(self) -> float:
        """Computing time of all stages, those of earlier runs included."""
        return sum(stage.seconds for stage in self.done.values())


def stage_key(name: str, settings: Mapping[str, object], inputs: Sequence[Stage]) -> str:
    """Hash of everything that decides the result of a stage."""
    parts = {
        "code": code_digest(PACKAGE),
        "libraries": {library: _version(library) for library in LIBRARIES},
        "name": name,
        "settings": settings,
        "inputs": [stage.key for stage in inputs],
    }
    text = json.dumps(parts, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def code_digest(package: Path) -> str:
    """Hash of the sources and data files below a folder, without those that only present results.

    Args:
        package: folder of a package.

    Returns:
        Hexadecimal SHA-256 over the relative paths and contents.
    """
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*")):
        name = path.relative_to(package).as_posix()
        if "__pycache__" in name or name.startswith(PRESENTATION) or not path.is_file():
            continue
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        digest.update(f"{name}\0{content}\n".encode())
    return digest.hexdigest()


def _version(library: str) -> str | None:
    try:
        return version(library)
    except PackageNotFoundError:
        return None


def _found(folder: Path, key: str, reused: bool) -> Stage | None:
    recover(folder)
    try:
        header = StageHeader.from_json((folder / STAGE_FILE).read_bytes(), str(folder), DataError)
    except (OSError, DataError):
        return None
    return Stage(folder, key, header.seconds, reused) if header.key == key else None
