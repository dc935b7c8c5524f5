"""Contact forces on scenes that nobody tuned for: the defaults on logs whose contact MuJoCo's solver makes.

    python benchmarks/solver_contacts.py --json result.json      # some minutes
    python benchmarks/solver_contacts.py --case ur5-noisy --seed 5

Each case differs from the bundled scenes in what a user's log differs in: masses of links that the robot file
does not have, more friction in joints and contact, noisy sensors, another robot. A log is exported as CSV in
degrees and milliseconds, imported, and fitted with the defaults of measured robots, without a force sensor.
The simulator's normal force on held-out stretches judges the prediction.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import warnings
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from foreign_log import mapping_of, rows_right, selected, write_foreign_log
from results_page import table

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.files import write_text
from forcegp.logs import import_log
from forcegp.models.registry import create
from forcegp.models.structured_fit import StructuredFit
from forcegp.scene import load_scene
from forcegp.simulate import Sensors, simulate

MODEL = "sgp"


@dataclass(frozen=True)
class Case:
    """A scene, and what is unlike the robot file.

    Attributes:
        scene: bundled scene.
        mass: largest relative error of the mass and the inertia of each link; the draws are uniform.
        solver: friction and tip, where they are not those of the scene.
        sensors: resolution and noise of the measurements.
        lift_probability: how often a waypoint lies above the surface; 0 leaves no free motion.
    """

    scene: str
    mass: float = 0.0
    solver: dict[str, object] = field(default_factory=dict)
    sensors: Sensors = field(default_factory=Sensors)
    lift_probability: float = 0.2


KUKA = {
    "tip_radius": 0.01,
    "joint_friction": (2.0, 2.0, 1.5, 1.0, 0.5, 0.5, 0.3),
    "joint_damping": (2.0, 2.0, 1.5, 1.0, 0.4, 0.4, 0.2),
}
FRICTION = {
    "friction": 0.6,
    "joint_friction": (8.0, 8.0, 6.0, 2.0, 2.0, 1.5),
    "joint_damping": (6.0, 6.0, 4.0, 1.0, 1.0, 0.6),
}
CASES = {
    "ur5": Case("ur5_wiping"),
    "ur5-noisy": Case("ur5_wiping", sensors=Sensors(2e-5, 1e-3, 0.3)),
    "ur5-friction": Case("ur5_wiping", solver=FRICTION),
    "ur5-masses": Case("ur5_wiping", mass=0.1),
    "panda": Case("panda_sphere"),
    "panda-noisy": Case("panda_sphere", sensors=Sensors(2e-5, 1e-3, 0.2)),
    "panda-masses": Case("panda_sphere", mass=0.1),
    "kuka": Case("kuka_plane", solver=KUKA),
    "kuka-masses": Case("kuka_plane", solver=KUKA, mass=0.1),
    "kuka-masses, all in contact": Case("kuka_plane", solver=KUKA, mass=0.1, lift_probability=0.0),
}
SECONDS, DT = 60.0, 0.004
"""Length of a log, and its sampling period [s]."""
MOTION = load_scene("ur5_wiping").simulation
"""The controller's gains and the pressing force; stiff contacts bounce less with damped ones."""


def with_other_masses(system: ConstrainedSystem, share: float, seed: int) -> ConstrainedSystem:
    """The system with links that are heavier or lighter than the robot file says."""
    robot, generator = system.robot, torch.Generator().manual_seed(seed)
    factor = 1.0 + share * (2.0 * torch.rand(robot.mass.shape, generator=generator, dtype=robot.dtype) - 1.0)
    return system.with_robot(
        replace(robot, mass=robot.mass * factor, inertia=robot.inertia * factor[:, None, None])
    )


def recorded(case: Case, seed: int) -> tuple[ConstrainedSystem, Dataset]:
    """The system of the scene, and a simulated log of the arm that is unlike it."""
    scene = load_scene(case.scene)
    system, config = scene.system(), scene.simulation
    solver = replace(config.solver, **case.solver)  # pyright: ignore[reportArgumentType]
    config = replace(config, duration=SECONDS, dt=DT, seed=seed, engine="mujoco", contact="solver")
    config = replace(config, solver=solver, sensors=case.sensors, gains=MOTION.gains)
    lifts = {"lift_probability": case.lift_probability, "lift_height": MOTION.lift_height}
    config = replace(config, **lifts, pressing_force=MOTION.pressing_force)
    log = simulate(with_other_masses(system, case.mass, seed), config).data
    return system, log.replace(header=log.header.model_copy(update={"robot_fingerprint": None}))


def scores(model: StructuredFit, test: Dataset) -> dict[str, float]:
    """Bias, standard deviation and correlation of the normal force where the contact is closed; coverage."""
    (name,) = model.system.contact_names
    closed = test.contact[name]
    force = test.contact_extras["multiplier"][name][closed]
    found = model.predict(
        test.q, test.qd, test.tau, "multiplier", active=test.active(model.system.contact_names), noise=True
    )
    assert found.std is not None
    mean, std = found.mean[closed, 0], found.std[closed, 0]
    return {
        "bias_N": float((mean - force).mean()),
        "std_N": float((mean - force).std()),
        "correlation": float(torch.corrcoef(torch.stack([mean, force]))[0, 1]),
        "coverage": float(((mean - force).abs() <= 2.0 * std).double().mean()),
        "force_N": float(force.mean()),
    }


def run(case: Case, seed: int) -> dict[str, float]:
    """From the simulator through CSV to the scores of a model."""
    system, truth = recorded(case, seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_foreign_log(folder / "run.csv", truth, system)
        write_text(folder / "mapping.toml", mapping_of(system, "distance"))
        log = import_log(folder / "run.csv", system, folder / "mapping.toml").data
    train, test = selected(log, truth, system)
    model = create(MODEL, system)
    began = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit = model.fit(train)
    seconds = time.perf_counter() - began
    assert isinstance(fit, StructuredFit)
    return {"rows_right": rows_right(log, truth, system), **scores(fit, test), "fit_seconds": seconds}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--case", choices=tuple(CASES), action="append", help="default: all")
    parser.add_argument("--seed", type=int, action="append", help="default: 0")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    found = {}
    for name in options.case or CASES:
        for seed in options.seed or [0]:
            found[f"{name}, seed {seed}"] = result = run(CASES[name], seed)
            print(f"{name}, seed {seed}: {result}", flush=True)
    rows = [
        [
            name,
            f"{100 * r['rows_right']:.2f} %",
            f"{r['force_N']:.1f}",
            f"{r['bias_N']:+.2f} ± {r['std_N']:.2f}",
            f"{r['correlation']:.3f}",
            f"{r['coverage']:.3f}",
        ]
        for name, r in found.items()
    ]
    print(
        table(
            ["case", "contact rows", "mean force [N]", "error of λ [N]", "correlation", "±2σ coverage"], rows
        )
    )
    if options.json:
        cases = {name: asdict(CASES[name]) for name in options.case or CASES}
        options.json.write_text(
            json.dumps({"cases": cases, "results": found}, indent=2) + "\n", encoding="utf-8"
        )


if __name__ == "__main__":
    main()
