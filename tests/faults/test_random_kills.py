"""Processes killed at random moments and started again: they end with the numbers of one that was left alone.

The short version kills a few; FORCEGP_ATTACK=1 kills fifty of each command.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from forcegp.data import Dataset

ATTACK = bool(os.environ.get("FORCEGP_ATTACK"))
KILLS = 50 if ATTACK else 2
HERE = Path(__file__).parent
SCENE = """
[robot]
model = "kuka_iiwa"
[[contact]]
name = "table"
frame = "lbr_iiwa_link_7"
point = [0.0, 0.0, 0.1]
surface = { type = "plane", normal = [0.0, 0.0, 1.0], offset = 0.055 }
[simulation]
duration = 0.2
"""

pytestmark = pytest.mark.skipif(os.name != "posix", reason="SIGKILL")


def started(command: list[str]) -> subprocess.Popen[str]:
    paths = os.pathsep.join([str(HERE.parent), *sys.path])
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )


def finished(command: list[str]) -> float:
    """Run a command to its end; how long it took [s]."""
    start = time.perf_counter()
    process = started(command)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors[-2000:]
    return time.perf_counter() - start


def killed(command: list[str], after: float) -> bool:
    """Kill a command; whether it was still running."""
    process = started(command)
    try:
        process.communicate(timeout=after)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    return process.returncode == -signal.SIGKILL


def numbers_of_model(folder: Path) -> dict[str, torch.Tensor]:
    return load_file(folder / "model" / "model.safetensors")


def numbers_of_log(folder: Path) -> dict[str, torch.Tensor]:
    log = Dataset.read(folder / "run.parquet")
    return {name: getattr(log, name) for name in ("t", "q", "qd", "tau", "qdd")}


def attacked(command_for, read, tmp_path: Path) -> None:
    """Kill a command at random moments until it gets through, and compare with an undisturbed run."""
    rng, alone, here = random.Random(0), tmp_path / "alone", tmp_path / "killed"
    alone.mkdir()
    here.mkdir()
    seconds = finished(command_for(alone))
    expected, deaths = read(alone), 0
    while deaths < KILLS:
        # Starting takes most of the time of a short run; moments near the end are those that write.
        deaths += killed(command_for(here), rng.uniform(0.3, 1.0) * seconds)
        if rng.random() < 0.2:
            break
    finished(command_for(here))
    found = read(here)
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in expected)
    assert sorted(os.listdir(here)) == sorted(os.listdir(alone)), "no litter"


def test_a_fit_resumes(tmp_path: Path) -> None:
    script = str(HERE / "fit_script.py")
    attacked(lambda folder: [sys.executable, script, str(folder)], numbers_of_model, tmp_path)


def test_a_simulation_starts_again(tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE)
    tool = [sys.executable, "-c", "from forcegp.cli import main; main()"]

    def command(folder: Path) -> list[str]:
        return [*tool, "simulate", "--scene", str(scene), "--out", str(folder / "run.parquet")]

    attacked(command, numbers_of_log, tmp_path)
