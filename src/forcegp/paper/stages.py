"""Stages that are run once: each leaves a folder, with the key of what went into it.

The key is a hash of the stage's name, format, settings and the keys of its inputs. A folder whose key
still fits is used as it is; a folder appears whole or not at all, so an interrupted run resumes with the
first stage that did not end.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

from forcegp.errors import DataError, ForceGPError
from forcegp.files import Header, atomic_directory, write_text

STAGE_FILE = "stage.json"
FORMAT = 3
"""Raised where what stages compute changes, in a way that their settings do not show."""


@runtime_checkable
class Advance(Protocol):
    """Moves a progress bar; `note` is a word on how it goes, such as the objective."""

    def __call__(self, done: int, total: int | None = None, note: str = "") -> None: ...


Progress = Callable[[str, int], AbstractContextManager[Advance]]
"""Opens a progress bar with a description and a total."""


def silent(description: str, total: int) -> AbstractContextManager[Advance]:
    """A progress bar that shows nothing."""

    def advance(done: int, total: int | None = None, note: str = "") -> None:
        pass

    return nullcontext(advance)


class StageHeader(Header):
    """What a stage's folder says about itself.

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
    """A stage that did not leave what it should."""


@dataclass(frozen=True)
class Stage:
    """A stage that is done.

    Attributes:
        folder: where its files are.
        key: of everything that went into it.
        seconds: how long it took when it was run.
        reused: whether it was found done.
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
        say: called with one line on every stage that ends.
    """

    def __init__(
        self, root: Path, progress: Progress = silent, say: Callable[[str], None] = lambda _: None
    ) -> None:
        self.root, self.progress, self.say = root, progress, say
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
            settings: everything but the inputs that decides the result; must be JSON.
            inputs: stages whose files are read.
            total: steps of the progress bar.

        Raises:
            StageError: the same name was run before with other settings.
        """
        key = stage_key(name, settings, inputs)
        folder = self.root / name
        stage = _found(folder, key)
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
            raise StageError(f"the stage {name!r} was asked for twice, with different settings")
        self.done[name] = stage
        return stage

    @property
    def seconds(self) -> float:
        """Computing time of all stages, those of earlier runs included."""
        return sum(stage.seconds for stage in self.done.values())


def stage_key(name: str, settings: Mapping[str, object], inputs: Sequence[Stage]) -> str:
    """Hash of everything that decides the result of a stage."""
    parts = {
        "format": FORMAT,
        "release": version("forcegp"),
        "name": name,
        "settings": settings,
        "inputs": [stage.key for stage in inputs],
    }
    text = json.dumps(parts, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _found(folder: Path, key: str) -> Stage | None:
    try:
        header = StageHeader.from_json((folder / STAGE_FILE).read_bytes(), str(folder), DataError)
    except (OSError, DataError):
        return None
    return Stage(folder, key, header.seconds, reused=True) if header.key == key else None
