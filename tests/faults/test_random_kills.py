"""Commands killed at random moments and started again: they end with the numbers of one that was left alone.

The short version kills a few; FORCEGP_ATTACK=1 kills fifty of each command. Every command runs in a process
of its own that is forked from one that has loaded the library, so that the kills meet work and not imports.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import sys
import time
from collections.abc import Iterator
from multiprocessing.context import ForkServerContext
from pathlib import Path

import pytest

from faults.commands import COMMANDS, Command, child, numbers, prepare, stages
from slow import slow_except

KILLS = 50 if os.environ.get("FORCEGP_ATTACK") else 3
PRELOADED = [
    *("faults.commands", "forcegp.simulate", "forcegp.logs", "reproduction.study"),
    *("forcegp.report.rollouts", "scipy.signal", "matplotlib.pyplot", "pybullet"),
]
"""What the commands import on their way; a module that is not installed is passed over."""
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

pytestmark = pytest.mark.skipif(os.name != "posix", reason="SIGKILL")


@pytest.fixture(scope="module")
def context() -> Iterator[ForkServerContext]:
    with pytest.MonkeyPatch.context() as patch:
        for name in ONE_THREAD:
            patch.setenv(name, "1")
        patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
        found = multiprocessing.get_context("forkserver")
        found.set_forkserver_preload(PRELOADED)
        first = found.Process(target=time.sleep, args=(0.0,))
        first.start()  # starts the server, which takes longer than a command
        first.join()
        yield found


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    prepare(folder)
    return folder


FAST = ("simulate", "import", "fit")
"""The others take as long as all of these together."""


@pytest.fixture(
    params=slow_except(COMMANDS.values(), *FAST, name=lambda command: command.name),
    ids=lambda command: command.name,
)
def command(request: pytest.FixtureRequest) -> Command:
    return request.param


class Runs:
    """Runs one command in processes of its own."""

    def __init__(self, context: ForkServerContext, name: str, inputs: Path, log: Path) -> None:
        self.context, self.name, self.inputs, self.log = context, name, inputs, log

    def run(self, out: Path, kill_after: float | None = None) -> bool:
        """Whether the command ran to its end; it may be killed before."""
        arguments = (self.name, str(self.inputs), str(out), str(self.log))
        process = self.context.Process(target=child, args=arguments)
        process.start()
        process.join(kill_after)
        if process.is_alive():
            process.kill()
            process.join()
        assert process.exitcode in (0, -signal.SIGKILL), self.log.read_text()[-3000:]
        return process.exitcode == 0


def test_killed_commands_end_with_the_same_numbers(
    command: Command, context: ForkServerContext, inputs: Path, tmp_path: Path
) -> None:
    runs, alone = Runs(context, command.name, inputs, tmp_path / "log.txt"), tmp_path / "alone"
    alone.mkdir()
    start = time.perf_counter()
    assert runs.run(alone)
    seconds = time.perf_counter() - start
    expected, rng, deaths, rounds = numbers(alone), random.Random(16), 0, 0
    while deaths < KILLS:
        here = tmp_path / f"round-{rounds}"
        here.mkdir()
        rounds += 1
        done: dict[str, int] = {}
        while not runs.run(here, rng.uniform(0.0, seconds) if deaths < KILLS else None):
            deaths += 1
            if command.name != "reproduce":
                assert complete(command, here, expected)
            done |= {name: at for name, at in stages(here).items() if name not in done}
        assert numbers(here) == expected, "files and numbers, and no litter"
        assert done.items() <= stages(here).items(), "finished stages are not run again"
    assert deaths == KILLS


def complete(command: Command, folder: Path, expected: dict[str, object]) -> bool:
    """Whether the target is not there, or whole with the numbers that it should have."""
    found = {
        n: v for n, v in numbers(folder).items() if n == command.target or n.startswith(f"{command.target}/")
    }
    return (
        not (folder / command.target).exists()
        or found.items()
        == {name: value for name, value in expected.items() if name.startswith(command.target)}.items()
    )
