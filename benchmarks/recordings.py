"""Payloads of two recordings in one fit, beside a fit of each.

    python benchmarks/recordings.py --arm ur5 --seed 0 1 2 3 4

An arm of `solver_arms.py` with right links, and friction and offsets of its torque sensors that the file
lacks, records a motion with each of two payloads. One fit shares friction and offsets. Errors are those of
the mass, root mean square of both payloads.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from real_cases import moving
from results_page import table
from solver_arms import ARMS, MAPPING, Arm
from write_back import WRONG

import forcegp
from forcegp.forces.priors.constants import PerRecording
from forcegp.forces.priors.inertial import PayloadPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.logs import parse_mapping

PAYLOADS, AWAY = (0.5, 2.0), 0.1
"""Masses [kg], and their distance from the origin of the last link along its z axis [m]."""
IMPERFECTIONS = replace(WRONG, mass=0.0, drive=0.0, offset=0.01)
SECONDS, EVERY = 10.0, 4


def recorded(robot: forcegp.RobotModel, seed: int, folder: Path) -> list[forcegp.Dataset]:
    """A log with each payload, of one arm with one friction."""
    arms, logs = [], []
    for k, mass in enumerate(PAYLOADS):
        carried = PayloadPrior(known=(mass, 0.0, 0.0, mass * AWAY)).loaded(robot)
        arm = Arm(carried, IMPERFECTIONS, np.random.default_rng(seed))
        arms.append(arm)
        for name in ("dof_damping", "dof_frictionloss"):
            getattr(arm.true, name)[:] = getattr(arms[0].true, name)
        arm.offset = arms[0].offset
        arm.random, arm.further = (np.random.default_rng([seed, k, j]) for j in range(2))
        arm.record(SECONDS, folder / f"{k}.csv")
        mapping = parse_mapping(f"{MAPPING}derivatives = {{ window = {arm.wrong.window} }}".encode(), "m")
        logs.append(moving(forcegp.read_log(folder / f"{k}.csv", robot, mapping))[::EVERY])
    return logs


def masses(robot: forcegp.RobotModel, logs: list[forcegp.Dataset]) -> list[float]:
    """Estimated payload of each log, by one fit of all [kg]."""
    parts = [int(log.segment.unique().numel()) for log in logs]
    payload = PayloadPrior(measured=True)
    prior = PerRecording(payload, tuple(np.cumsum([0, *parts[:-1]]).tolist()))
    model = forcegp.StructuredGP(
        forcegp.ConstrainedSystem(robot), "analytical", [JointFrictionPrior(), prior]
    )
    fit = model.fit(forcegp.Dataset.concatenate(logs))
    mean = fit.posterior.latent.latent_mean(1, {"one": torch.zeros(1, 1, dtype=torch.float64)})[0]
    return (mean.view(len(logs), -1)[:, 0] * payload.mass).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arm", choices=ARMS, nargs="*", default=["ur5"])
    parser.add_argument("--seed", type=int, nargs="*", default=[0, 1, 2, 3, 4])
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    rows, result = [], {}
    for name in options.arm:
        robot = forcegp.load_robot(name)
        for seed in options.seed:
            with tempfile.TemporaryDirectory() as folder:
                logs = recorded(robot, seed, Path(folder))
            together = masses(robot, logs)
            found = {"one fit": together, "two fits": [x for log in logs for x in masses(robot, [log])]}
            result[f"{name}, seed {seed}"] = found
            errors = [float(np.sqrt(np.mean(np.subtract(x, PAYLOADS) ** 2))) for x in found.values()]
            rows.append(
                [name, str(seed), *(f"{1e3 * x:.1f}" for x in errors), f"{errors[0] / errors[1]:.2f}"]
            )
            print(*rows[-1], found, flush=True)
    print(table(["arm", "seed", "one fit [g]", "two fits [g]", "ratio"], rows))
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
