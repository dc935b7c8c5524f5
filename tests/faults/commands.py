"""The commands that are killed at random moments: their inputs, how they run, the numbers that they leave."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import load_file

import forcegp
from forcegp.cli import app, main
from forcegp.data import Dataset
from forcegp.destination import MANIFEST
from forcegp.forces.priors.sets import default_priors
from reproduction import profiles
from reproduction.__main__ import app as study
from reproduction.profiles import Profile
from reproduction.stages import STAGE_FILE

SCENE = """
[robot]
model = "kuka_iiwa"
[[contact]]
name = "table"
frame = "lbr_iiwa_link_7"
point = [0.0, 0.0, 0.1]
surface = { type = "plane", normal = [0.0, 0.0, 1.0], offset = 0.055 }
[simulation]
duration = 0.15
"""
MAPPING = """
time = { column = "t" }
position = { column = "q{joint}", unit = "rad" }
velocity = { column = "v{joint}", unit = "rad/s" }
torque = { column = "tau{joint}", unit = "Nm" }
contact.table = { source = "always" }
[joints]
"""
SMALL = Profile(
    "quick",
    duration=2.0,
    seeds=1,
    sizes=(8,),
    paper_kernels_up_to=0,
    main=8,
    baseline_points=30,
    networks=(),
    stretch=0.3,
    test_samples=10,
    multiplier_seconds=0.5,
    identification_points=8,
    identification_evaluations=3,
    rollout_seconds=0.1,
    rollout_starts=2,
    rollout_samples=2,
    paper_split_baselines=False,
)
"""A reproduction that takes seconds; what it shows is not looked at."""
PROCESSES = 2 if os.environ.get("FORCEGP_ATTACK") else 1
"""Starting further processes takes longer than the small reproduction itself."""
VARYING = ("seconds", "computing_time_s", "peak_memory", "sha256")
"""Ends of the keys of what differs between two runs: times, memory, and hashes of files that hold them."""


@dataclass(frozen=True)
class Command:
    """A command of the program.

    Attributes:
        name: of the command.
        arguments: from the folder of its inputs and the one where its results go.
        target: what it writes there.
        resumes: whether a second run takes up what a killed one has done.
    """

    name: str
    arguments: Callable[[Path, Path], list[object]]
    target: str
    resumes: bool = False


COMMANDS = {
    command.name: command
    for command in (
        Command("simulate", lambda i, o: ["-s", i / "scene.toml", "-o", o / "run.parquet"], "run.parquet"),
        Command(
            "import",
            lambda i, o: [
                *(i / "log.csv", "-s", i / "scene.toml"),
                *("-m", i / "mapping.toml", "-o", o / "log.parquet"),
            ],
            "log.parquet",
        ),
        Command(
            "fit",
            lambda i, o: [
                *("-s", i / "scene.toml", "-d", i / "train.parquet", "-m", "sgp-zero"),
                *("-o", o / "model"),
            ],
            "model",
        ),
        Command(
            "rollout",
            lambda i, o: ["-m", i / "model", "-d", i / "run.parquet", "--samples", 2, "-o", o / "rollout"],
            "rollout",
        ),
        Command(
            "reproduce",
            lambda i, o: ["--profile", "quick", "--processes", PROCESSES, "-o", o / "out"],
            "out",
            resumes=True,
        ),
    )
}


def prepare(folder: Path) -> None:
    """Write what the commands read."""
    (folder / "scene.toml").write_text(SCENE)
    execute("simulate", folder, folder)
    run, system = Dataset.read(folder / "run.parquet"), forcegp.load_scene(folder / "scene.toml").system()
    run[::6].write(folder / "train.parquet")
    model = forcegp.StructuredGP(system, "analytical", default_priors(system, "analytical"), 0.1).fit(
        run[::12], options=forcegp.models.LearningOptions(max_evaluations=2)
    )
    model.save(folder / "model")
    joints = enumerate(system.robot.joint_names)
    (folder / "mapping.toml").write_text(MAPPING + "".join(f'{name} = "{j}"\n' for j, name in joints))
    names = [f"{kind}{j}" for kind in ("q", "v", "tau") for j in range(system.robot.nq)]
    rows = torch.cat([run.t[:, None], run.q, run.qd, run.tau], dim=1).tolist()
    lines = [",".join(["t", *names]), *(",".join(map(repr, row)) for row in rows)]
    (folder / "log.csv").write_text("\n".join(lines) + "\n")


def execute(name: str, inputs: Path, out: Path) -> None:
    """Run a command in this process."""
    profiles.PROFILES["quick"] = SMALL
    program, names = (study, ["reproduction"]) if name == "reproduce" else (app, ["forcegp", name])
    sys.argv = [*names, *map(str, COMMANDS[name].arguments(inputs, out))]
    try:
        main(program)
    except SystemExit as ended:
        if ended.code:
            raise


def child(name: str, inputs: str, out: str, log: str) -> None:
    """Run a command in a process of its own, with its words in a file."""
    with open(log, "w", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    execute(name, Path(inputs), Path(out))


def numbers(folder: Path) -> dict[str, object]:
    """Everything that a command left, by file, without what differs between two runs."""
    return {str(path.relative_to(folder)): _content(path) for path in files(folder)}


def files(folder: Path) -> Iterator[Path]:
    """All files below a folder, in order."""
    return (path for path in sorted(folder.rglob("*")) if path.is_file())


def stages(folder: Path) -> dict[str, int]:
    """The finished stages of a reproduction, and when each was finished [ns]."""
    return {str(path): path.stat().st_mtime_ns for path in files(folder) if path.name == STAGE_FILE}


def _content(path: Path) -> object:
    if path.suffix == ".safetensors":
        return {name: value.numpy().tobytes() for name, value in load_file(path).items()}
    if path.name == MANIFEST:
        return None
    if path.suffix == ".json":
        return _fixed(json.loads(path.read_bytes()))
    return None if path.suffix in (".html", ".md", ".svg") else path.read_bytes()


def _fixed(value: object) -> object:
    if isinstance(value, dict):
        return {key: _fixed(part) for key, part in value.items() if not key.endswith(VARYING)}
    return [_fixed(part) for part in value] if isinstance(value, list) else value
