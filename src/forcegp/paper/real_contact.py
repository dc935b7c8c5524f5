"""From a foreign log to a contact force: the whole line on scenes whose contact MuJoCo's solver makes.

Simulate, export as CSV in degrees and milliseconds, import, check, select, fit, evaluate: each step as a user
takes it on the command line. Models never see the simulator's forces, which only judge them.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from forcegp import kinematics
from forcegp.checks import Report, check
from forcegp.checks import read_log as read_checked
from forcegp.constraints import ConstrainedSystem, Plane, SurfaceContact
from forcegp.data import Dataset, complement, split_by_stretches, without_marked_impacts
from forcegp.errors import DataError
from forcegp.evaluation import evaluate
from forcegp.files import write_json, write_text
from forcegp.logs import import_log
from forcegp.logs.surface_fit import fit_surface
from forcegp.models.base import Predictor
from forcegp.models.load import load_model
from forcegp.models.registry import create
from forcegp.models.sensed import force_from_sensor, sensor_noise_std, with_sensor
from forcegp.models.structured_gp import StructuredGP
from forcegp.paper.foreign_log import mapping_of, write_foreign_log
from forcegp.paper.stages import Advance, Stage, Stages
from forcegp.report.check import write_check
from forcegp.scene import load_scene
from forcegp.simulate import simulate

SCENES = ("ur5_wiping", "panda_sphere")
SOURCES = ("distance", "wrench")
"""What contact is detected from; the first is what the models are fitted with."""
MODEL = "sgp-real"
VARIANTS = ("file", "torques", "sensor")
"""The robot file alone; fitted to accelerations; and to the wrist sensor's force too, which is then also a
measurement at the states that are predicted."""
MATCHED = 1e-6
"""Rounding of the exported positions [rad]."""


def simulated(stages: Stages, scene: str, duration: float, seed: int) -> Stage:
    """The simulated log `run.parquet` of a scene."""

    def make(folder: Path, advance: Advance) -> None:
        read = load_scene(scene)
        config = dataclasses.replace(read.simulation, duration=duration, seed=seed)
        result = simulate(read.system(), config, progress=lambda done, total: advance(done, total))
        result.data.write(folder / "run.parquet")

    return stages.run(f"{scene}/simulate", make, settings={"duration": duration, "seed": seed})


def imported(stages: Stages, scene: str, run: Stage) -> Stage:
    """The log exported as CSV (`run.csv`) and imported (`log.parquet`), with the check's page."""

    def make(folder: Path, advance: Advance) -> None:
        system = load_scene(scene).system()
        truth = Dataset.read(run / "run.parquet")
        write_foreign_log(folder / "run.csv", truth, system)
        logs: dict[str, Dataset] = {}
        for source in SOURCES:
            write_text(folder / f"{source}.toml", mapping_of(system, source))
            logs[source] = import_log(folder / "run.csv", system, folder / f"{source}.toml").data
        right = {source: rows_right(log, truth, system) for source, log in logs.items()}
        numbers: dict[str, Any] = {"rows_right": right}
        log = logs[SOURCES[0]]
        log.write(folder / "log.parquet")
        numbers["surface"] = surface_error(log, system)
        numbers["check"] = _checked(folder, scene, system).to_dict()
        write_json(folder / "import.json", numbers)

    return stages.run(f"{scene}/import", make, settings={}, inputs=[run])


def _checked(folder: Path, scene: str, system: ConstrainedSystem) -> Report:
    log = read_checked(folder / "log.parquet")
    report = check(system, log)
    write_check(folder / "check.html", f"log.parquet on {scene}", report, system, log)
    return report


def rows_right(log: Dataset, truth: Dataset, system: ConstrainedSystem) -> float:
    """Share of the imported rows whose contact is the simulator's."""
    name, rows = system.contact_names[0], rows_of(log, truth)
    return float((log.contact[name] == truth.contact[name][rows]).double().mean())


def rows_of(log: Dataset, truth: Dataset) -> torch.Tensor:
    """The simulated row of each imported one.

    Raises:
        DataError: the positions are not those of the simulation.
    """
    first = int((truth.q - log.q[0]).abs().amax(-1).argmin())
    since = (log.t - log.t[0]) / truth.t.diff().median()
    rows = first + since.round().long()
    if int(rows[-1]) >= len(truth) or float((truth.q[rows] - log.q).abs().max()) > MATCHED:
        raise DataError("the imported rows are not those of the simulation")
    return rows


def surface_error(log: Dataset, system: ConstrainedSystem) -> dict[str, float]:
    """How far the surface fitted to the tip's path is from the scene's, along the path [mm] and [degrees]."""
    (contact,) = system.contacts
    assert isinstance(contact, SurfaceContact)
    fit = fit_surface(log, system, contact.name, "plane" if isinstance(contact.surface, Plane) else "sphere")
    q = log.q[log.contact[contact.name]]
    point = kinematics.point_position(system.robot, q, contact.frame, tuple(contact.point))
    normal = contact.surface.gradient(point)
    touching = point - contact.center_surface.value(point)[:, None] * normal - contact.radius * normal
    turned = torch.linalg.cross(fit.surface.gradient(touching), normal).norm(dim=-1)
    return {
        "offset_mm": 1e3 * float(fit.surface.value(touching).abs().mean()),
        "tilt_degrees": float(np.degrees(turned.max())),
    }


def selected(log: Dataset, truth: Dataset, system: ConstrainedSystem) -> tuple[Dataset, Dataset]:
    """The log but for held-out stretches, and these with the simulator's normal force.

    Rows at impacts are left out, as by `forcegp select`: no smooth acceleration describes them.
    """
    log = without_marked_impacts(log)
    split = split_by_stretches(log, 1)
    name, rows = system.contact_names[0], rows_of(log, truth)
    force = {name: truth.contact_extras["multiplier"][name][rows]}
    known = log.replace(contact_extras={**log.contact_extras, "multiplier": force})
    return log[complement(split.test, len(log))], known[split.test]


def fitted(stages: Stages, scene: str, variant: str, run: Stage, log: Stage) -> Stage:
    """A model folder, and its scores on held-out stretches (`evaluation.json`)."""

    def make(folder: Path, advance: Advance) -> None:
        system = load_scene(scene).system()
        data, truth = Dataset.read(log / "log.parquet"), Dataset.read(run / "run.parquet")
        train, test = selected(data, truth, system)
        model = _model(variant, system, train, lambda done, most, value: advance(done, most, f"{value:.4g}"))
        model.save(folder / "model")
        write_json(folder / "evaluation.json", evaluate(model, test, train=train).to_dict())

    return stages.run(f"{scene}/{variant}", make, settings={}, inputs=[run, log])


def _model(
    variant: str, system: ConstrainedSystem, train: Dataset, progress: Callable[[int, int, float], None]
) -> Predictor:
    if variant == "file":
        return create("analytical", system)
    model = create(MODEL, system)
    assert isinstance(model, StructuredGP)
    if variant == "sensor":
        return model.fit(with_sensor(train, system, sensor_noise_std(train, system)), progress=progress)
    return model.fit(train, progress=progress)


def force_of(stage: Stage, test: Dataset) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and standard deviation of the normal force of a fitted model at states, `(n,)` each [N]."""
    model = load_model(stage / "model")
    assert isinstance(model, StructuredGP)
    fit, active = model, test.active(model.system.contact_names)
    if "multiplier" in fit.noise:
        return force_from_sensor(fit, test)
    states = test.q, test.qd, test.tau
    found = fit.predict(*states, "multiplier", active=active, noise=True)
    assert found.std is not None
    return found.mean[:, 0], found.std[:, 0]


def numbers_of(stage: Stage, name: str) -> dict[str, Any]:
    """The numbers that a stage wrote."""
    return json.loads((stage / name).read_text(encoding="utf-8"))
