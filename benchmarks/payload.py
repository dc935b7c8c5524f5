"""A payload of 1 kg, added in the middle of a simulated log: how fast predictions follow.

    python benchmarks/payload.py --json result.json

A KUKA arm, free and on a plane, is simulated twice along the same plan, without and with the payload; the
log goes from one to the other after six seconds. The model knows the first six. Then it takes 10 samples at
a time (42 ms), in three ways: not at all, with a memory that fades with time, and with `follow`, which
forgets on evidence. Errors are those of accelerations without noise, of the 10 samples that come next.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import torch

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.forces.priors.inertial import PayloadPrior
from forcegp.models.following import follow
from forcegp.models.structured_fit import StructuredFit
from forcegp.models.structured_gp import StructuredGP
from forcegp.robot import load_robot
from forcegp.scene import load_scene
from forcegp.simulate import SimulationConfig, simulate

PAYLOAD = 1.0
"""[kg]."""
STEP, KNOWN, EVERY, RATE = 10, 1440, 4, 240
"""Samples per update, samples before the payload, every which of them is learned from, samples per second."""
MEMORY = 0.5
"""Of the way that fades with time [s]."""
AFTER = (0.1, 0.5, 1.0)
"""From when on errors are averaged, over a quarter of a second [s]."""


def logs(system: ConstrainedSystem) -> tuple[Dataset, Dataset]:
    """The first six seconds without payload, and the seconds after them with it."""
    mass = system.robot.mass.clone()
    mass[-1] += PAYLOAD
    config = SimulationConfig(duration=9.0, seed=1)
    free = simulate(system, config).data
    loaded = simulate(system.with_robot(system.robot.replace(mass=mass)), config).data
    return free[:KNOWN], loaded.replace(header=free.header)[KNOWN:]


def error(model: StructuredFit, data: Dataset) -> float:
    """Mean absolute error of clean accelerations [rad/s²]."""
    predicted = model.predict(data.q, data.qd, data.tau, covariance=False).mean
    return float((predicted - data.extras["qdd_clean"]).abs().mean())


def fading(fit: StructuredFit, data: Dataset) -> StructuredFit:
    """Forget the payload at a constant rate."""
    return fit.forget(math.exp(-STEP / RATE / MEMORY), priors=["payload"]).update(data)


WAYS: dict[str, Callable[[StructuredFit, Dataset], StructuredFit]] = {
    "frozen": lambda fit, data: fit,
    "fading memory": fading,
    "on evidence": lambda fit, data: follow(fit, data, ["payload"]).fit,
}


def measure(system: ConstrainedSystem) -> dict[str, dict[str, float]]:
    """Errors of each way, before and after the payload, and milliseconds of an update."""
    known, loaded = logs(system)
    default = StructuredGP(system, "analytical", noise=0.1).fit(known[::EVERY], learn=[])
    priors = [*default.posterior.priors, PayloadPrior()]
    found = {}
    for name, way in WAYS.items():
        model = StructuredGP(system, "analytical", priors, noise=0.1, inference="sparse")
        fit = model.fit(known[::EVERY], learn=[])
        before, errors, began = error(fit, known[1::EVERY]), [], time.perf_counter()
        for first in range(0, int(1.5 * RATE), STEP):
            errors.append(error(fit, loaded[first : first + STEP]))
            fit = way(fit, loaded[first : first + STEP])
        per = 1e3 * (time.perf_counter() - began) / len(errors)
        latent, one = fit.posterior.latent, {"one": torch.zeros(1, 1, dtype=torch.float64)}
        mass = float(latent.latent_mean(len(priors) - 1, one)[0, 0])
        found[name] = {
            "before": before,
            "first": errors[0],
            "mass": mass,
            "ms_per_update_and_prediction": per,
        }
        for seconds in AFTER:
            last = round(seconds * RATE / STEP)
            found[name][f"after_{seconds:g}_s"] = sum(errors[last : last + 6]) / 6
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    systems = {
        "free": ConstrainedSystem(load_robot("kuka_iiwa")),
        "on a plane": load_scene("kuka_plane").system(),
    }
    result = {name: measure(system) for name, system in systems.items()}
    print(json.dumps(result, indent=2))
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
