"""Trajectories in open loop: every model, from states of a motion that none of them saw (section 4)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from forcegp.data import Dataset
from forcegp.errors import DataError
from forcegp.experiments.fits import Fit
from forcegp.experiments.profiles import Profile
from forcegp.experiments.stages import Advance, Stage, Stages
from forcegp.experiments.task import LOG, SCENE, Task, simulation_settings
from forcegp.files import write_text
from forcegp.report.rollout_data import RolloutData, rollout_data, with_bands
from forcegp.rollout import Comparison, compare
from forcegp.scene import load_scene
from forcegp.simulate import simulate

ROLLOUTS = "data.json"
OTHER_MOTION = 1000
"""Added to the task's seed for the motion that no model saw."""
BAND_SECONDS, BAND_STARTS = 2.0, 5
"""At most so long, and from so many starts, are function samples rolled out: in open loop errors grow until
they reach the size of the motion, and what a band holds from then on says little about the model."""


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
            "band_starts": BAND_STARTS,
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
    data = Dataset.read(simulated / LOG)

    def found(what: str, seconds: float, starts: int, samples: int) -> Comparison:
        def progress(done: int, total: int) -> None:
            advance(done, total, what)

        return compare(models, data, seconds, starts, samples, system=task.system, progress=progress)

    paths = rollout_data(found("means", sizes.rollout_seconds, sizes.rollout_starts, 0))
    seconds, starts = min(BAND_SECONDS, sizes.rollout_seconds), min(BAND_STARTS, sizes.rollout_starts)
    bands = rollout_data(found("function samples", seconds, starts, sizes.rollout_samples))
    write_text(folder / ROLLOUTS, with_bands(paths, bands).to_json())
