"""Whether one half of a real log predicts the other: errors and ±2σ coverage of torque by joint.

    python benchmarks/halves.py --json result.json                      # some minutes
    python benchmarks/halves.py --log motion_b --logs path/to/real

The recordings (segments) of a log of the KUKA iiwa14 are split into two halves: the first and the last ones,
or every other one. The model is fitted to one half and predicts the other, both ways. Errors and
coverage are counted as on real logs (`real_logs.py`), on samples in motion.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from real_cases import Case, existing, moving
from real_logs import LOGS, numbers, scores
from real_models import structured
from torch import Tensor

import forcegp
from forcegp.errors import DataError

MOTIONS = ("motion_a", "motion_b")
HALVES: dict[str, Callable[[Tensor], Tensor]] = {
    "in order": lambda segment: 2 * segment < segment.max() + 1,
    "alternating": lambda segment: segment % 2 == 0,
}
"""Which samples are in the first half, by the number of their recording."""
REQUIRED = 0.85
"""Smallest coverage of any joint that passes."""


def cases_of(data: forcegp.Dataset, name: str, robot: forcegp.RobotModel) -> list[Case]:
    """Both ways of training on one half and testing on the other, for each way of halving the recordings."""
    system, found = forcegp.ConstrainedSystem(robot), []
    for halving, of in HALVES.items():
        first = of(data.segment)
        for train, test in ((data[first], data[~first]), (data[~first], data[first])):
            number = len(found) % 2 + 1
            found.append(
                Case(f"{name}, {halving}, half {number} trains", system, train, {"other half": test})
            )
    return found


def run(case: Case) -> dict:
    """Scores of a model on the other half."""
    fitted, test = structured(case), moving(case.tests["other half"])
    found = scores(fitted.predict(test), test, case.system.robot)
    assert fitted.fit is not None
    learned = {key: value.tolist() for key, value in fitted.fit.hyperparameters.items()}
    return found | {"hyperparameters": learned, "seconds": fitted.seconds, **fitted.notes}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--logs", type=Path, default=LOGS, help="folder of the logs (default: ../shared/real)"
    )
    parser.add_argument("--log", choices=MOTIONS, nargs="*", default=list(MOTIONS))
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    result: dict[str, dict] = {}
    robot = forcegp.load_robot("kuka_iiwa14")
    try:
        for name in options.log:
            path = existing(options.logs / "kuka_iiwa14" / name)
            for case in cases_of(forcegp.read_log(path, robot, "iiwa14_txt"), name, robot):
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    result[case.name] = found = run(case)
                coverage = found["torque_coverage"]
                geometric = float(torch.tensor(found["torque_rmse"]).log().mean().exp())
                print(
                    f"{case.name}: RMSE {numbers(found['torque_rmse'])} (geometric mean {geometric:.3f}) "
                    "N m, "
                    f"coverage {numbers(coverage)}{'' if min(coverage) >= REQUIRED else ' FAILS'}, "
                    f"κ {found['power']:.4f}, {found['seconds']:.0f} s",
                    flush=True,
                )
    except DataError as error:
        sys.exit(str(error))
    least = min(min(found["torque_coverage"]) for found in result.values())
    print(f"smallest coverage of a joint: {least:.2f} (required: {REQUIRED})")
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
