"""Faults at chosen steps: a process that dies, or a call that fails, at its n-th step in the file system.

Every step below a folder is one of Python's audit events (open, mkdir, rename, remove, …); `fsync`, which has
none, raises an event of its own.
"""

from __future__ import annotations

import os
import resource
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

from forcegp import files as files_module

KILLED, ENDED, REFUSED, RAW, SURVIVED = 77, 0, 3, 4, 5
"""Exit codes of a child: killed; ended without a fault; an OSError; another error; ended in spite of it."""

STEPS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.chmod", "step"}

Fault = Callable[[], None]


def die() -> None:
    """End the process at once, as SIGKILL does: nothing is flushed, no `finally` runs."""
    os._exit(KILLED)


def in_child(action: Callable[[], object], root: Path, step: int, fault: Fault) -> int:
    """Run an action in a child process with a fault at its n-th step below a folder; its exit code."""
    child = os.fork()
    if child == 0:
        try:
            fired = _inject(root, step, fault)
            code = _outcome(action)
            code = SURVIVED if code == ENDED and fired else code
        except BaseException:
            traceback.print_exc()
            code = RAW
        os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def limited_child(action: Callable[[], object], size: int) -> int:
    """Run an action in a child process that cannot write files of more bytes than `size`; its exit code."""
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        os._exit(_outcome(action))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _outcome(action: Callable[[], object]) -> int:
    try:
        action()
    except OSError:
        return REFUSED
    except BaseException:
        traceback.print_exc()
        return RAW
    return ENDED


def _inject(root: Path, step: int, fault: Fault) -> list[int]:
    """Arm the fault; the list is empty until it happens."""
    count, fired = 0, list[int]()

    def note(event: str, arguments: tuple) -> None:
        nonlocal count
        if fired or event not in STEPS or not str(arguments[0]).startswith(str(root)):
            return
        count += 1
        if count == step:
            fired.append(step)
            fault()

    def announced(module: object, name: str, place: Callable[..., object]) -> None:
        original = getattr(module, name)

        def call(*arguments: object) -> object:
            sys.audit("step", str(place(*arguments)))
            return original(*arguments)

        setattr(module, name, call)

    announced(files_module, "_sync", lambda path: path)
    sys.addaudithook(note)
    return fired
