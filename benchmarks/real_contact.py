"""A real contact with a measured force: the defaults on a hopping leg, trained on either half of the log.

    python benchmarks/real_contact.py --json result.json      # half a minute
    python benchmarks/real_contact.py --logs path/to/real

The leg stands and squats in the first half of `hopper/hopping`; it jumps, lands, squats deeper and stands in
the second. The force sensor under the foot is never an input. All signals pass the same Savitzky-Golay
filter. The height sensor tells where the base is, up to a constant, and when the foot is in the air.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from real_cases import existing
from results_page import table
from scipy.signal import savgol_filter

import forcegp
from forcegp import kinematics
from forcegp.errors import DataError
from forcegp.models.structured_fit import StructuredFit

LOGS = Path(__file__).resolve().parents[2] / "shared" / "real"
DT, ORDER, WINDOW = 1e-3, 3, 61
"""Sampling period [s]; degree and window of the filter [samples]."""
FIRST, SECOND = (0.03, 1.40), (1.40, 2.96)
"""The halves [s], without half a window at the ends."""
LIFTED = 0.009
"""The foot is in the air from this height above its median of the first half [m]: between the 8 mm that the
height sensor is off in contact, and the 11 to 15 mm of the flight."""
SIGNALS = ("height_sensors", "joint_positions", "joint_torques", "ati_force")


def columns(folder: Path) -> dict[str, NDArray[np.float64]]:
    """The signals of a log in their common samples."""
    read = {name: np.loadtxt(existing(folder / f"dg_hopper_teststand-{name}.dat")) for name in SIGNALS}
    first, last = max(x[0, 0] for x in read.values()), min(x[-1, 0] for x in read.values())
    return {name: x[(x[:, 0] >= first) & (x[:, 0] <= last), 1:] for name, x in read.items()}


def hopping(logs: Path) -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset]:
    """The leg on its slider above the ground, and the log; `multiplier` is the measured vertical force."""
    robot = forcegp.load_robot(existing(logs / "hopper" / "teststand.urdf"))
    raw = columns(logs / "hopper" / "hopping")
    t = DT * np.arange(len(raw["height_sensors"]))

    def filtered(x: NDArray[np.float64], degree: int = 0) -> torch.Tensor:
        smooth = savgol_filter(x, WINDOW, ORDER, deriv=degree, delta=DT, axis=0)
        return torch.from_numpy(np.ascontiguousarray(smooth))

    q = np.concatenate([raw["height_sensors"], raw["joint_positions"]], axis=1)
    foot = kinematics.frame_pose(robot, filtered(q), "contact")[1][:, 2]
    ground = float(foot[(t >= FIRST[0]) & (t < FIRST[1])].median())
    contact = forcegp.SurfaceContact(
        name="ground",
        frame="contact",
        point=(0.0, 0.0, 0.0),
        surface=forcegp.Plane(normal=(0.0, 0.0, 1.0), offset=ground),
    )
    # The slider has neither a motor nor a sensor of its force.
    tau = np.concatenate([np.zeros_like(raw["height_sensors"]), raw["joint_torques"]], axis=1)
    data = forcegp.Dataset(
        t=torch.from_numpy(t),
        q=filtered(q),
        qd=filtered(q, 1),
        qdd=filtered(q, 2),
        tau=filtered(tau),
        joint_names=robot.joint_names,
        contact={"ground": foot < ground + LIFTED},
        contact_extras={"multiplier": {"ground": filtered(raw["ati_force"][:, 2])}},
    )
    return forcegp.ConstrainedSystem(robot, [contact]), data


def between(data: forcegp.Dataset, half: tuple[float, float]) -> forcegp.Dataset:
    """The samples from the first time to before the second."""
    return data[(data.t >= half[0]) & (data.t < half[1])]


def scores(fit: StructuredFit, test: forcegp.Dataset) -> dict[str, object]:
    """Errors, error bars and coverage of the vertical force where the foot is on the ground."""
    found = fit.predict(test.q, test.qd, test.tau, "multiplier", active=test.active(("ground",)), noise=True)
    assert found.std is not None
    closed = test.contact["ground"]
    error = (found.mean[:, 0] - test.multiplier["ground"])[closed]
    std = found.std[closed, 0]
    return {
        "samples": len(error),
        "rmse_N": float(error.square().mean().sqrt()),
        "bias_N": float(error.mean()),
        "median_std_N": float(std.median()),
        "coverage": float((error.abs() <= 2.0 * std).double().mean()),
        "warnings": list(found.warnings),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--logs", type=Path, default=LOGS, help="folder of the logs (default: ../shared/real)"
    )
    parser.add_argument("--json", type=Path, help="write all results to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    try:
        system, data = hopping(options.logs)
    except DataError as error:
        sys.exit(str(error))
    halves, result = {"first half": FIRST, "second half": SECOND}, {}
    for train in halves:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fit = forcegp.StructuredGP(system, "analytical").fit(between(data, halves[train]))
        for test in halves:
            result[f"{train} trains, {test} tests"] = scores(fit, between(data, halves[test]))
    rows = [
        [name, *(f"{r[key]:.2f}" for key in ("rmse_N", "bias_N", "median_std_N")), f"{r['coverage']:.3f}"]
        for name, r in result.items()
    ]
    print(table(["", "RMSE of λ [N]", "bias [N]", "median σ [N]", "±2σ coverage"], rows))
    for name, found in result.items():
        for warning in found["warnings"]:
            print(f"{name}: {warning}")
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
