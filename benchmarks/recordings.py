"""Recordings of one arm with different offsets and payloads: default fits that know them, and that do not.

    python benchmarks/recordings.py --json result.json                       # some minutes
    python benchmarks/recordings.py --case offsets --seed 0 1 2 --arm ur5 kuka_iiwa14

An arm of `solver_arms.py` records several motions, each with its own offsets of the torque sensors, its own
payload, or neither. The defaults know the recordings and find payloads, `one log` does not know them, and
`payloads` is given the payload of each recording as a point mass. Errors, over those of `one log`, and ±2σ
coverage of torques are counted as on real logs (`real_logs.py`), on another motion of a training recording
(`known`), and on another recording (`new`). The case `masses` compares payloads from one fit of all
recordings with those from a fit of each [kg].
"""

from __future__ import annotations

import argparse
import json
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from real_cases import IN_MOTION, moving
from real_logs import scores
from real_models import Predicted
from results_page import table
from solver_arms import ARMS, MAPPING, Arm, Imperfections
from write_back import WRONG

import forcegp
from forcegp.data.fields import UNKNOWN
from forcegp.forces.priors.constants import OffsetPrior, PerRecording
from forcegp.forces.priors.inertial import PayloadPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.forces.priors.memory import BristlePrior
from forcegp.logs import parse_mapping
from forcegp.models.structured_fit import StructuredFit

PAYLOADS, AWAY = (0.5, 2.0), 0.1
"""Masses [kg], and their distance from the origin of the last link along its z axis [m]."""
RIGHT_LINKS = replace(WRONG, mass=0.0, drive=0.0, offset=0.01)
CASES = {"same": (0.0, 0.0), "offsets": (0.03, 0.0), "small offsets": (0.01, 0.0), "payloads": (0.0, 2.0)}
"""Largest offset of a recording, over the largest torque, and largest payload [kg]."""
RECORDINGS, SECONDS, EVERY = 3, 20.0, 4
MASS_SECONDS = 10.0


def recorded(
    robot: forcegp.RobotModel,
    wrong: Imperfections,
    seed: int,
    folder: Path,
    payloads: Sequence[float],
    offsets: Sequence[float],
    seconds: float = SECONDS,
) -> list[forcegp.Dataset]:
    """A log with each payload and offset, of one arm with one friction."""
    arms, logs, base, random = [], [], 0.0, np.random.default_rng([seed, 1])
    shifts = {offset: random.uniform(-1.0, 1.0, robot.nq) for offset in dict.fromkeys(offsets)}
    for k, (mass, offset) in enumerate(zip(payloads, offsets, strict=True)):
        carried = PayloadPrior(known=(mass, 0.0, 0.0, mass * AWAY)).loaded(robot) if mass else robot
        arm = Arm(carried, wrong, np.random.default_rng(seed))
        arms.append(arm)
        base = arm.offset if k == 0 else base
        for name in ("dof_damping", "dof_frictionloss", "dof_armature"):
            getattr(arm.true, name)[:] = getattr(arms[0].true, name)
        arm.offset = base + offset * shifts[offset] * arms[0].scale
        arm.random, arm.further = (np.random.default_rng([seed, k, j]) for j in range(2))
        arm.record(seconds, folder / f"log_{k}.csv")
        mapping = parse_mapping(f"{MAPPING}derivatives = {{ window = {arm.wrong.window} }}".encode(), "m")
        logs.append(forcegp.read_log(folder / f"log_{k}.csv", robot, mapping))
    return logs


def scored(fit: StructuredFit, data: forcegp.Dataset, robot: forcegp.RobotModel) -> dict:
    """Errors and coverage along a log, at the samples in motion."""
    moves = data.qd.abs().amax(-1) > IN_MOTION
    found = fit.predict_log(data, noise=True)
    assert found.covariance is not None
    return scores(Predicted(found.mean[moves], found.covariance[moves], fit.system), data[moves], robot)


def compare(robot: forcegp.RobotModel, case: str, seed: int, folder: Path) -> dict:
    """Scores of a fit that knows the recordings, and of one that does not."""
    spread, mass = CASES[case]
    # A distinct offset for each recording; the last but one repeats the first.
    sizes = [spread * (1.0 + 1e-9 * k) for k in range(RECORDINGS + 1)]
    loads = np.random.default_rng([seed, 2]).uniform(0.0, mass, RECORDINGS + 1).tolist()
    *train, known, new = recorded(
        robot,
        Imperfections(offset=0.0),
        seed,
        folder,
        [*loads[:-1], loads[0], loads[-1]],
        [*sizes[:-1], sizes[0], sizes[-1]],
    )
    together = forcegp.Dataset.concatenate(train)
    unknown = together.replace(recording=torch.full_like(together.recording, UNKNOWN))
    tests, found = {"known": known.named(train[0].recordings[0]), "new": new}, {}
    system, payloads = (
        forcegp.ConstrainedSystem(robot),
        PerRecording(PayloadPrior(measured=True), together.recordings),
    )
    priors = [JointFrictionPrior(), BristlePrior(), OffsetPrior(together.recordings), payloads]
    models = {
        "recordings": (together, {}),
        "one log": (unknown, {}),
    }
    if mass:
        models["payloads"] = together, {"force_priors": priors, "inertia": "auto"}
    for name, (data, given) in models.items():
        fit = forcegp.StructuredGP(system, "analytical", **given).fit(data)
        worth = {key: x for key, x in fit.result.worth.items() if key.startswith(("recordings", "payload"))}
        found[name] = {test: scored(fit, log, robot) for test, log in tests.items()} | {"worth": worth}
    return found


def row_of(found: dict) -> list[str]:
    """Coverage without recordings, and ratios of errors and coverage with them, means over the joints."""
    row = []
    for test in ("known", "new"):
        without = found["one log"][test]
        row.append(f"{np.mean(without['torque_coverage']):.2f}")
        for name in ("recordings", "payloads"):
            if name not in found:
                row.append("–")
                continue
            each = found[name][test]
            ratio = np.log(np.divide(each["torque_rmse"], without["torque_rmse"])).mean()
            row.append(f"{np.exp(ratio):.2f}, {np.mean(each['torque_coverage']):.2f}")
    return row


def masses(robot: forcegp.RobotModel, logs: list[forcegp.Dataset]) -> list[float]:
    """Estimated payload of each log, by one fit of all [kg]."""
    data, payload = forcegp.Dataset.concatenate(logs), PayloadPrior(measured=True)
    prior = PerRecording(payload, data.recordings)
    model = forcegp.StructuredGP(
        forcegp.ConstrainedSystem(robot), "analytical", [JointFrictionPrior(), prior]
    )
    fit = model.fit(data)
    mean = fit.posterior.latent.latent_mean(1, {"one": torch.zeros(1, 1, dtype=torch.float64)})[0]
    return (mean.view(-1, len(logs) + 1)[0, :-1] * payload.mass).tolist()


def compare_masses(robot: forcegp.RobotModel, seed: int, folder: Path) -> dict:
    """Payloads of one fit, and of a fit of each."""
    logs = recorded(robot, RIGHT_LINKS, seed, folder, PAYLOADS, (0.0, 0.0), MASS_SECONDS)
    logs = [moving(log)[::EVERY] for log in logs]
    return {
        "one fit": masses(robot, logs),
        "two fits": [x for log in logs for x in masses(robot, [log])],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arm", choices=ARMS, nargs="*", default=["ur5"])
    parser.add_argument("--case", choices=[*CASES, "masses"], nargs="*", default=[*CASES, "masses"])
    parser.add_argument("--seed", type=int, nargs="*", default=[0, 1, 2, 3, 4])
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    rows, mass_rows, result = [], [], {}
    for name in options.arm:
        robot = forcegp.load_robot(name)
        for case in options.case:
            for seed in options.seed:
                with tempfile.TemporaryDirectory() as folder:
                    if case == "masses":
                        found = compare_masses(robot, seed, Path(folder))
                        errors = [
                            float(np.sqrt(np.mean(np.subtract(x, PAYLOADS) ** 2))) for x in found.values()
                        ]
                        row = [name, str(seed), *(f"{1e3 * x:.1f}" for x in errors)]
                        mass_rows.append([*row, f"{errors[0] / errors[1]:.2f}"])
                    else:
                        found = compare(robot, case, seed, Path(folder))
                        row = [name, case, str(seed), *row_of(found)]
                        rows.append(row)
                result[f"{name}, {case}, seed {seed}"] = found
                print(*row, flush=True)
    heads = [f"{test}: {x}" for test in ("known", "new") for x in ("one log", "defaults", "payloads")]
    print(table(["arm", "case", "seed", *heads], rows) if rows else "")
    print(table(["arm", "seed", "one fit [g]", "two fits [g]", "ratio"], mass_rows) if mass_rows else "")
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
