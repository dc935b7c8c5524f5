"""Trajectories in open loop: every model, from states of a motion that none of them saw (section 4)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from forcegp.data import Dataset
from forcegp.errors import DataError
from forcegp.files import write_text
from forcegp.paper.fits import Fit
from forcegp.paper.profiles import Profile
from forcegp.paper.stages import Advance, Stage, Stages
from forcegp.paper.task import LOG, SCENE, Task, simulation_settings
from forcegp.report.rollout_data import RolloutData, rollout_data, with_bands
from forcegp.rollout import compare
from forcegp.scene import load_scene
from forcegp.simulate import simulate

ROLLOUTS = "data.json"
OTHER_MOTION = 1000
"""Added to the task's seed for the motion that no model saw."""
BAND_SECONDS = 2.0
"""At most so long are function samples rolled out [s]: each costs a trajectory more from every start."""
CALIBRATION_STARTS = 2
"""Trajectories that bands are calibrated on, for each of those that they are tried on."""


def rollouts(stages: Stages, sizes: Profile, task: Task, fits: Sequence[Fit]) -> RolloutData:
    """The data of the section on trajectories, or what was found before.

    Args:
        stages: where it is kept.
        sizes: length and number of the trajectories.
        task: whose scene is simulated once more.
        fits: the models.
    """
    simulated = _unseen_motion(stages, sizes, task)
    stage = stages.run(
        "figures/rollouts",
        lambda folder, advance: _roll(sizes, task, fits, simulated, folder, advance),
        settings={
            "seconds": sizes.rollout_seconds,
            "starts": sizes.rollout_starts,
            "samples": sizes.rollout_samples,
            "band_seconds": BAND_SECONDS,
        },
        inputs=[simulated, *(fit.stage for fit in fits)],
    )
    return RolloutData.from_json((stage / ROLLOUTS).read_bytes(), str(stage / ROLLOUTS), DataError)


def _unseen_motion(stages: Stages, sizes: Profile, task: Task) -> Stage:
    """The task once more with other waypoints, long enough for starts whose trajectories do not overlap."""
    scene = load_scene(SCENE)
    config = dataclasses.replace(
        scene.simulation,
        duration=sizes.rollout_starts * sizes.rollout_seconds,
        seed=task.seed + OTHER_MOTION,
    )

    def make(folder: Path, advance: Advance) -> None:
        result = simulate(task.system, config, progress=lambda done, _: advance(done))
        result.data.write(folder / LOG)

    settings = simulation_settings(scene, config)
    return stages.run("simulate/rollout", make, settings=settings, total=config.steps)


def _roll(
    sizes: Profile, task: Task, fits: Sequence[Fit], simulated: Stage, folder: Path, advance: Advance
) -> None:
    """Mean trajectories from all starts over the whole time, and bands over a part of it."""
    models = {fit.name: fit.load() for fit in fits}
    sampled = {name: model for name, model in models.items() if model.has_function_samples}
    data, system = Dataset.read(simulated / LOG), task.system
    seconds, starts = sizes.rollout_seconds, sizes.rollout_starts

    def reported(what: str) -> Callable[[int, int], None]:
        return lambda done, total: advance(done, total, what)

    paths = compare(models, data, seconds, starts, system=system, progress=reported("means"))
    seconds, samples = min(BAND_SECONDS, seconds), sizes.rollout_samples
    bands = compare(
        sampled, data, seconds, starts, samples, system=system, progress=reported("function samples")
    )
    seconds = min(seconds, sizes.stretch)
    calibration = compare(
        sampled,
        task.data,
        seconds,
        _calibration_starts(task, seconds, CALIBRATION_STARTS * starts),
        samples,
        system=system,
        progress=reported("their calibration"),
    )
    found = with_bands(rollout_data(paths), rollout_data(bands, calibration))
    write_text(folder / ROLLOUTS, found.to_json())


def _calibration_starts(task: Task, seconds: float, most: int) -> torch.Tensor:
    """Rows of held-out stretches, spread over the log and over what a stretch is longer than a trajectory.

    Stretches begin where a line of the motion does; starts at any of its phases are like those they are for.
    """
    stretches, dt = task.stretches(), task.data.header.dt
    assert dt is not None
    chosen = torch.linspace(0, len(stretches) - 1, min(most, len(stretches))).round().long().tolist()
    steps = round(seconds / dt)
    rows = []
    for i, k in enumerate(chosen):
        first, end = stretches[k]
        spare = max(0, end - first - 1 - steps)
        rows.append(first + round(spare * _phase(i)))
    return torch.tensor(rows)


def _phase(i: int) -> float:
    """The i-th of numbers spread over [0, 1), in an order that follows no other (golden ratio)."""
    return (0.5 + i * 0.6180339887498949) % 1.0
