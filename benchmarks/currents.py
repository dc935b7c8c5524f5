"""Currents with wrong torque constants: arms that MuJoCo moves, learned with the defaults.

    python benchmarks/currents.py --json currents.json         # four arms, four seeds

The true constants differ from the nominal ones in the mapping by up to 25 %, and the arm from its file as in
`solver_arms.py`: masses of links by up to `--mass`, drives, friction, offsets and noise. Errors of the scales
are scored, and accelerations of another motion beside those of a fit to which the nominal constants are true.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from real_cases import example_robot
from solver_arms import CASES, Arm

import forcegp
from forcegp.files import write_text
from forcegp.logs import parse_mapping

ARMS = ("franka_panda", "kuka_iiwa14", "ur5", "ur10")
WRONG = 0.25
"""Largest relative error of a torque constant."""
SECONDS = {"train": 40.0, "test": 15.0}
MAPPING = """
time = { column = "t" }
position = { column = "q.{joint}", unit = "rad" }
torque = { column = "tau.{joint}", unit = "A", torque_constant = 1.0 }
"""
KNOWN = MAPPING.replace("1.0 }", "1.0, torque_constant_std = 0.0 }")


def compared(name: str, seed: int, mass: float) -> dict[str, Any]:
    """Scales and errors of accelerations of one arm."""
    robot = example_robot("ur_description/urdf/ur10_robot.urdf") if name == "ur10" else None
    wrong = replace(CASES["plain"], gain=WRONG, mass=mass)
    arm = Arm(robot or forcegp.load_robot(name), wrong, np.random.default_rng(seed))
    logs = {}
    with tempfile.TemporaryDirectory() as made:
        for part, seconds in SECONDS.items():
            path = Path(made) / f"{part}.csv"
            arm.record(seconds, path)
            for mapping in (MAPPING, KNOWN):
                logs[part, mapping] = forcegp.read_log(
                    path, arm.robot, parse_mapping(mapping.encode(), "currents")
                )
    begin, errors, coverage = time.perf_counter(), {}, {}
    fits = {}
    for mapping in (MAPPING, KNOWN):
        fits[mapping] = forcegp.StructuredGP(forcegp.ConstrainedSystem(arm.robot)).fit(logs["train", mapping])
        test = logs["test", mapping]
        found = fits[mapping].predict(test.q, test.qd, test.tau, "qdd", noise=True)
        error, std = found.mean - test.qdd, found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        errors[mapping] = error.square().mean(0).sqrt().numpy()
        coverage[mapping] = float((error.abs() <= 2.0 * std).double().mean())
    own = {p.name: p for p in fits[MAPPING].parameters()}
    scales = [own[f"drives.scale of {joint}"] for joint in arm.robot.joint_names]
    return {
        "case": f"{name}, seed {seed}",
        "errors": [float(p.value - (1.0 / gain - 1.0)) for p, gain in zip(scales, arm.gain, strict=True)],
        "std": [p.std for p in scales],
        "determined": [p.determined for p in scales],
        "acceleration": float(np.exp(np.log(errors[MAPPING] / errors[KNOWN]).mean())),
        "coverage": [coverage[MAPPING], coverage[KNOWN]],
        "seconds": time.perf_counter() - begin,
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arm", choices=ARMS, action="append")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--mass", type=float, default=0.15, help="largest relative error of a link's mass")
    parser.add_argument("--json", type=Path, help="write the results there")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    results = []
    for name in arguments.arm or ARMS:
        for seed in range(arguments.seeds):
            results.append(one := compared(name, seed, arguments.mass))
            median = np.median(np.abs(one["errors"]))
            shown = (
                f"{sum(one['determined'])} of {len(one['std'])} scales determined, median error {median:.3f}"
            )
            ratio = f"accelerations {one['acceleration']:.3f} × those of nominal constants"
            rest = f"±2σ holds {one['coverage'][0]:.2f}; {one['seconds']:.0f} s"
            print(f"{one['case']}: {shown}; {ratio}; {rest}", flush=True)
    errors, std = (np.concatenate([one[key] for one in results]) for key in ("errors", "std"))
    known = np.concatenate([one["determined"] for one in results])
    within = np.abs(errors) <= 2.0 * std
    print(
        f"{len(errors)} scales: ±2σ holds {within.mean():.2f}; {known.sum()} determined: "
        f"{within[known].mean():.2f}, median error {np.median(np.abs(errors[known])):.3f}, "
        f"median σ {np.median(std[known]):.3f}, largest {np.max(np.abs(errors / std)):.1f}σ"
    )
    if arguments.json:
        write_text(arguments.json, json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
