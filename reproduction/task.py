"""The task of the paper: simulate the arm sliding over the table, and choose training points."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset, Split, complement, split_by_selection, split_by_stretches
from forcegp.errors import DataError
from forcegp.files import Header, atomic_file, write_json
from forcegp.scene import load_scene
from forcegp.simulate import check_engine, make_engine, simulate
from reproduction.stages import DATA, Stage, write_data

SCENE = "kuka_plane"
LOG, MOTION, SUMMARY = "run.parquet", "motion.safetensors", "summary.json"


class RowsFile(Header):
    """The rows of both splits of the run with a seed."""

    FORMAT: ClassVar[str] = "forcegp-rows"
    VERSION: ClassVar[int] = 1
    MAX_BYTES: ClassVar[int] = 1 << 26

    seed: int
    train: dict[str, list[int]]
    test: dict[str, list[int]]
    stretches: list[tuple[int, int]]


@dataclass(frozen=True)
class Task:
    """A simulated run with the training and test rows of both splits.

    Attributes:
        seed: seed for the run.
        system: robot and contacts.
        data: the log.
        splits: by name, see `SPLITS`.
    """

    seed: int
    system: ConstrainedSystem
    data: Dataset
    splits: dict[str, Split]

    @classmethod
    def read(cls, run: Path, rows: Path) -> Task:
        """Return the task from the folders of its two stages."""
        chosen = RowsFile.from_json((rows / DATA).read_bytes(), str(rows / DATA), DataError)
        splits = {
            name: Split(
                torch.tensor(chosen.train[name]),
                torch.tensor(chosen.test[name]),
                tuple(chosen.stretches) if name == "stretches" else (),
            )
            for name in chosen.train
        }
        return cls(chosen.seed, load_scene(SCENE).system(), Dataset.read(run / LOG), splits)

    @property
    def noise_std(self) -> float:
        """Standard deviation of the acceleration noise given to the models [rad/s²]."""
        noise = self.data.header.noise_std
        assert noise is not None
        return noise

    def train(self, split: str, points: int) -> Dataset:
        """Return the first `points` training samples of a split, or evenly spaced ones if fewer were
        selected.
        """
        chosen = self.splits[split]
        if points <= len(chosen.train):
            return self.data[chosen.train[:points]]
        rows = complement(chosen.test, len(self.data))
        most = min(points, len(rows))
        return self.data[rows[torch.linspace(0, len(rows) - 1, most).round().long()]]

    def test(self, split: str, most: int) -> Dataset:
        """Return at most `most` evenly spaced test samples of a split.

        The header does not name the logged robot, since models with learned parameters are tested.
        """
        rows = self.splits[split].test
        if len(rows) > most:
            rows = rows[torch.linspace(0, len(rows) - 1, most).round().long()]
        test = self.data[rows]
        return test.replace(header=test.header.model_copy(update={"robot_fingerprint": None}))

    def stretches(self) -> list[tuple[int, int]]:
        """Return the held-out stretches as (first row, last row + 1)."""
        return list(self.splits["stretches"].stretches)

    def held_out(self) -> Dataset:
        """Return the samples of the first held-out stretch."""
        return self.data[slice(*self.stretches()[0])]

    def around(self, seconds: float, step: int) -> Tensor:
        """Return the rows of some seconds around the first held-out stretch, thinned."""
        dt = self.data.header.dt
        assert dt is not None
        (start, stop), wanted = self.stretches()[0], round(seconds / dt)
        first = max(0, min((start + stop - wanted) // 2, len(self.data) - wanted))
        return torch.arange(first, min(first + wanted, len(self.data)), step)


def task_stages(root: Path, duration: float, seed: int, points: int, stretch: float) -> tuple[Stage, Stage]:
    """Return the two stages of a task: the simulated run, and its training and test rows.

    Args:
        root: folder of the stages.
        duration: duration of the run [s].
        seed: seed for both stages.
        points: maximum number of training points.
        stretch: duration of a held-out stretch [s].
    """
    run = Stage(root, f"simulate/seed-{seed}", simulate_task, {"duration": duration, "seed": seed})
    settings = {"points": points, "stretch": stretch, "seed": seed}
    return run, Stage(root, f"select/seed-{seed}", select_rows, settings, (run,))


def simulate_task(folder: Path, *, duration: float, seed: int) -> None:
    """Write the log, the planned and executed motion of the tool, and statistics of the run."""
    scene = load_scene(SCENE)
    system = scene.system()
    config = dataclasses.replace(scene.simulation, duration=duration, seed=seed)
    result = simulate(system, config)
    result.data.write(folder / LOG)
    names = ("position", "velocity", "acceleration")
    motion = {f"planned_{name}": getattr(result.reference, name) for name in names}
    motion |= {name: getattr(result, name) for name in (*names, "c")}
    motion |= {name: getattr(result.reference, name) for name in ("waypoints", "segment")}
    with atomic_file(folder / MOTION) as path:
        save_file({name: values.contiguous() for name, values in motion.items()}, str(path))
    engine = make_engine(system.robot, config.dt, config.engine)
    try:
        check = check_engine(system, engine, torch.Generator().manual_seed(seed))
    finally:
        engine.close()
    checked = {f"check_{name}": value for name, value in dataclasses.asdict(check).items()}
    write_json(folder / SUMMARY, dict(result.summary()) | checked)


def select_rows(folder: Path, run: Path, *, points: int, stretch: float, seed: int) -> None:
    """Write the rows of both splits."""
    data = Dataset.read(run / LOG)
    held = split_by_stretches(data, points, stretch=stretch, seed=seed)
    papers = split_by_selection(data, points, seed=seed)
    rows = RowsFile(
        seed=seed,
        train={"stretches": held.train.tolist(), "selection": papers.train.tolist()},
        test={"stretches": held.test.tolist(), "selection": papers.test.tolist()},
        stretches=list(held.stretches),
    )
    write_data(folder, rows)


def motion_of(run: Path) -> dict[str, Tensor]:
    """Return the planned and executed motion of the tool, and the constraint error, by name."""
    return load_file(str(run / MOTION))


def summary_of(run: Path) -> dict[str, float | int | str]:
    """Return statistics of the simulated run, by name."""
    return json.loads((run / SUMMARY).read_text(encoding="utf-8"))
