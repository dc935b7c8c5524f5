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
from forcegp.files import Header, write_json, write_text
from forcegp.paper.profiles import Profile
from forcegp.paper.stages import Advance, Stage, Stages
from forcegp.scene import Scene, load_scene
from forcegp.simulate import SimulationConfig, check_engine, make_engine, simulate

SCENE = "kuka_plane"
LOG, MOTION, SUMMARY, ROWS = "run.parquet", "motion.safetensors", "summary.json", "rows.json"


@dataclass(frozen=True)
class Task:
    """A simulated run with the training and test rows of both splits.

    Attributes:
        seed: of the run.
        system: robot and contacts.
        data: the log.
        motion: planned and executed motion of the tool, constraint error, by name.
        summary: numbers on the simulated run, by name.
        splits: by name, see `SPLITS`.
        simulated, selected: the stages that made it.
    """

    seed: int
    system: ConstrainedSystem
    data: Dataset
    motion: dict[str, Tensor]
    summary: dict[str, float | int | str]
    splits: dict[str, Split]
    simulated: Stage
    selected: Stage

    def train(self, split: str, points: int) -> Dataset:
        """The first `points` training samples of a split; of more than were selected, evenly spaced ones."""
        chosen = self.splits[split]
        if points <= len(chosen.train):
            return self.data[chosen.train[:points]]
        rows = complement(chosen.test, len(self.data))
        most = min(points, len(rows))
        return self.data[rows[torch.linspace(0, len(rows) - 1, most).round().long()]]

    def test(self, split: str, most: int) -> Dataset:
        """At most `most` test samples of a split, spread evenly over all of them.

        The header does not name the logged robot, as models with learned parameters are tested on them.
        """
        rows = self.splits[split].test
        if len(rows) > most:
            rows = rows[torch.linspace(0, len(rows) - 1, most).round().long()]
        test = self.data[rows]
        return test.replace(header=test.header.model_copy(update={"robot_fingerprint": None}))

    def stretches(self) -> list[tuple[int, int]]:
        """The held-out stretches as (first row, one past the last)."""
        return list(self.splits["stretches"].stretches)


class RowsFile(Header):
    """The rows of both splits."""

    FORMAT: ClassVar[str] = "forcegp-rows"
    VERSION: ClassVar[int] = 1

    train: dict[str, list[int]]
    test: dict[str, list[int]]
    stretches: list[tuple[int, int]]


def make_task(stages: Stages, profile: Profile, seed: int) -> Task:
    """Simulate and select, or use the results of an earlier run."""
    scene = load_scene(SCENE)
    system = scene.system()
    config = dataclasses.replace(scene.simulation, duration=profile.duration, seed=seed)
    simulated = stages.run(
        f"simulate/seed-{seed}",
        lambda folder, advance: _simulate(system, config, folder, advance),
        settings=simulation_settings(scene, config),
        total=config.steps,
    )
    data = Dataset.read(simulated / LOG)
    most = max(profile.baseline_points, *profile.sizes)
    selected = stages.run(
        f"select/seed-{seed}",
        lambda folder, advance: _select(data, most, profile.stretch, seed, folder, advance),
        settings={"points": most, "stretch": profile.stretch},
        inputs=[simulated],
        total=2 * most,
    )
    return Task(
        seed=seed,
        system=system,
        data=data,
        motion=load_file(str(simulated / MOTION)),
        summary=json.loads((simulated / SUMMARY).read_text(encoding="utf-8")),
        splits=_read_splits(selected / ROWS),
        simulated=simulated,
        selected=selected,
    )


def simulation_settings(scene: Scene, config: SimulationConfig) -> dict[str, object]:
    """Everything that decides a simulated run, as JSON."""
    sections = json.loads(json.dumps(scene.sections.model_dump(mode="json")))
    return {"scene": sections, "simulation": dataclasses.asdict(config)}


def _simulate(system: ConstrainedSystem, config: SimulationConfig, folder: Path, advance: Advance) -> None:
    result = simulate(system, config, progress=lambda done, _: advance(done))
    result.data.write(folder / LOG)
    planned = result.reference
    save_file(
        {
            "planned_position": planned.position.contiguous(),
            "planned_velocity": planned.velocity.contiguous(),
            "planned_acceleration": planned.acceleration.contiguous(),
            "position": result.position.contiguous(),
            "velocity": result.velocity.contiguous(),
            "acceleration": result.acceleration.contiguous(),
            "waypoints": planned.waypoints.contiguous(),
            "segment": planned.segment.contiguous(),
            "c": result.c.contiguous(),
        },
        str(folder / MOTION),
    )
    engine = make_engine(system.robot, config.dt, config.engine)
    try:
        check = check_engine(system, engine, torch.Generator().manual_seed(config.seed))
    finally:
        engine.close()
    checked = {f"check_{name}": value for name, value in dataclasses.asdict(check).items()}
    write_json(folder / SUMMARY, dict(result.summary()) | checked)


def _select(data: Dataset, most: int, stretch: float, seed: int, folder: Path, advance: Advance) -> None:
    def second(done: int) -> None:
        advance(most + done)

    held = split_by_stretches(data, most, stretch=stretch, seed=seed, progress=lambda done: advance(done))
    papers = split_by_selection(data, most, seed=seed, progress=second)
    rows = RowsFile(
        train={"stretches": held.train.tolist(), "selection": papers.train.tolist()},
        test={"stretches": held.test.tolist(), "selection": papers.test.tolist()},
        stretches=list(held.stretches),
    )
    write_text(folder / ROWS, rows.model_dump_json())


def _read_splits(path: Path) -> dict[str, Split]:
    rows = RowsFile.model_validate_json(path.read_bytes())
    return {
        name: Split(
            torch.tensor(rows.train[name]),
            torch.tensor(rows.test[name]),
            tuple(rows.stretches) if name == "stretches" else (),
        )
        for name in rows.train
    }
