"""From an external log to a contact force: the full pipeline on scenes simulated with MuJoCo's solver.

Simulate, export as CSV in degrees and milliseconds, import, check, select, fit and evaluate, as a user would
on the command line. The simulator's forces are only used to score the models.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks.foreign_log import mapping_of, rows_right, selected, surface_error, write_foreign_log
from forcegp.checks import Report, check
from forcegp.checks import read_log as read_checked
from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.evaluation import evaluate
from forcegp.files import write_json, write_text
from forcegp.logs import import_log
from forcegp.models.analytical import AnalyticalModel
from forcegp.models.base import FittedModel
from forcegp.models.load import load_model
from forcegp.models.registry import create
from forcegp.models.sensed import force_from_sensor, sensor_noise_std, with_sensor
from forcegp.models.structured_fit import StructuredFit
from forcegp.models.structured_gp import StructuredGP
from forcegp.report import write_check
from forcegp.scene import load_scene
from forcegp.simulate import simulate
from reproduction.stages import Stage

SCENES = ("ur5_wiping", "panda_sphere")
SOURCES = ("distance", "wrench")
"""Sources of contact detection; the models are fitted with the first."""
RUN, LOG, IMPORTED, EVALUATED = "run.parquet", "log.parquet", "import.json", "evaluation.json"
VARIANTS = ("file", "torques", "sensor")
"""The robot file alone, a fit to accelerations, and a fit to accelerations and the force of a wrist sensor,
which then also serves as a measurement at the predicted states."""


@dataclass(frozen=True)
class Line:
    """The stages of one scene.

    Attributes:
        scene: name of the scene.
        run: the simulated log.
        log: the log exported as CSV and imported, with the check's page.
        fits: a model and its scores on held-out stretches, by variant.
    """

    scene: str
    run: Stage
    log: Stage
    fits: dict[str, Stage]


def line_of(root: Path, scene: str, duration: float, seed: int) -> Line:
    """Return the stages of a scene for a run of given duration."""
    settings: dict[str, Any] = {"scene": scene}
    run = Stage(root, f"{scene}/simulate", make_run, settings | {"duration": duration, "seed": seed})
    log = Stage(root, f"{scene}/import", make_log, settings, (run,))

    def fit(variant: str) -> Stage:
        return Stage(root, f"{scene}/{variant}", make_fit, settings | {"variant": variant}, (run, log))

    return Line(scene, run, log, {variant: fit(variant) for variant in VARIANTS})


def make_run(folder: Path, *, scene: str, duration: float, seed: int) -> None:
    """Write the simulated log `run.parquet`."""
    read = load_scene(scene)
    config = dataclasses.replace(read.simulation, duration=duration, seed=seed)
    simulate(read.system(), config).data.write(folder / RUN)


def make_log(folder: Path, run: Path, *, scene: str) -> None:
    """Write the log as CSV (`run.csv`) and imported (`log.parquet`), the check's page, and their numbers."""
    system, truth = load_scene(scene).system(), Dataset.read(run / RUN)
    write_foreign_log(folder / "run.csv", truth, system)
    logs: dict[str, Dataset] = {}
    for source in SOURCES:
        write_text(folder / f"{source}.toml", mapping_of(system, source))
        logs[source] = import_log(folder / "run.csv", system, folder / f"{source}.toml").data
    log = logs[SOURCES[0]]
    log.write(folder / LOG)
    numbers = {
        "rows_right": {source: rows_right(log, truth, system) for source, log in logs.items()},
        "surface": surface_error(log, system),
        "check": _checked(folder, scene, system).to_dict(),
    }
    write_json(folder / IMPORTED, numbers)


def _checked(folder: Path, scene: str, system: ConstrainedSystem) -> Report:
    log = read_checked(folder / LOG)
    report = check(system, log)
    write_check(folder / "check.html", f"log.parquet on {scene}", report, system, log)
    return report


def make_fit(folder: Path, run: Path, log: Path, *, scene: str, variant: str) -> None:
    """Write a model, and its scores on held-out stretches (`evaluation.json`)."""
    system = load_scene(scene).system()
    train, test = selected(Dataset.read(log / LOG), Dataset.read(run / RUN), system)
    model = _model(variant, system, train)
    model.save(folder / "model")
    write_json(folder / EVALUATED, evaluate(model, test, train=train).to_dict())


def _model(variant: str, system: ConstrainedSystem, train: Dataset) -> FittedModel:
    if variant == "file":
        return AnalyticalModel(system).nominal()
    model = create("sgp", system)
    assert isinstance(model, StructuredGP)
    if variant == "sensor":
        return model.fit(with_sensor(train, system, sensor_noise_std(train, system)))
    return model.fit(train)


def force_of(stage: Stage, test: Dataset) -> tuple[torch.Tensor, torch.Tensor]:
    """Return mean and standard deviation of a model's normal force at states, `(n,)` each [N]."""
    fit = load_model(stage.folder / "model")
    assert isinstance(fit, StructuredFit)
    active = test.active(fit.system.contact_names)
    if "multiplier" in fit.noise:
        return force_from_sensor(fit, test)
    states = test.q, test.qd, test.tau
    found = fit.predict(*states, "multiplier", active=active, noise=True)
    assert found.std is not None
    return found.mean[:, 0], found.std[:, 0]


def numbers_of(stage: Stage, name: str) -> dict[str, Any]:
    """Return the numbers written by a stage."""
    return json.loads((stage.folder / name).read_text(encoding="utf-8"))
