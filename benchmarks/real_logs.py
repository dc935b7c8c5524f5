"""Real logs: every model on a KUKA iiwa14 and on a double pendulum, beside the robot file and least squares.

    python benchmarks/real_logs.py --json result.json                      # a minute or two
    python benchmarks/real_logs.py --case iiwa14 --docs benchmarks/notes/real_logs.md
    python benchmarks/real_logs.py --logs path/to/real

Errors are counted on samples in motion of recordings that no model was trained on. The error of a predicted
acceleration is M(q) (q̈_predicted − q̈_measured) as a torque, with the mass matrix of the model's own robot (of
the robot file for models that have none). Ratios are to least squares, which identifies inertial parameters,
Coulomb and viscous friction and offsets, each link physically consistent.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from pathlib import Path

import torch
from real_cases import CASES, Case, evenly, moving
from real_models import LEAST_SQUARES, Predicted, Predictor, models
from real_plots import draw_errors
from real_rollouts import NAME, run_rollouts
from results_page import table, write_section

import forcegp
from forcegp import dynamics
from forcegp.errors import DataError

LOGS = Path(__file__).resolve().parents[2] / "shared" / "real"
COLUMNS = [
    "model",
    "torque RMSE by joint [N m]",
    "geometric mean / least squares",
    "/ least squares in motion",
    "/ least squares, one mass matrix for all",
    "squared acceleration error by joint / least squares",
    "±2σ coverage of torque by joint",
    "response to torque by joint",
]
RESPONSE_SAMPLES = 500
"""States at which a torque is added."""


@torch.no_grad()
def scores(predicted: Predicted, data: forcegp.Dataset, robot: forcegp.RobotModel) -> dict:
    """Errors and coverage by joint; the mass matrix of `robot`, that of the file, serves all models alike."""
    error = predicted.mean - data.qdd
    alike = (dynamics.mass_matrix(robot, data.q) @ error[..., None])[..., 0]
    M = dynamics.mass_matrix(predicted.system.robot, data.q)
    torque = (M @ error[..., None])[..., 0]
    found = {
        "torque_rmse": torque.square().mean(0).sqrt().tolist(),
        "torque_rmse_one_mass_matrix": alike.square().mean(0).sqrt().tolist(),
        "acceleration_mse": error.square().mean(0).tolist(),
    }
    if predicted.covariance is not None:
        pairs = {
            "torque": (torque, M @ predicted.covariance @ M.mT),
            "acceleration": (error, predicted.covariance),
        }
        for name, (miss, covariance) in pairs.items():
            inside = miss.abs() <= 2.0 * covariance.diagonal(dim1=-2, dim2=-1).sqrt()
            found[f"{name}_coverage"] = inside.to(miss.dtype).mean(0).tolist()
    return found


@torch.no_grad()
def torque_response(predict: Predictor, data: forcegp.Dataset) -> list[float]:
    """Share of an added torque that acts, by joint: 1 of a rigid robot, 0 of a model that cancels the torque.

    Random torques of a tenth of the spread of those logged, which no controller chose, are added; what acts
    is M(q) times the change of the predicted acceleration.
    """
    data, generator = evenly(data, RESPONSE_SAMPLES), torch.Generator().manual_seed(0)
    added = torch.randn(data.tau.shape, generator=generator, dtype=data.dtype) * (0.1 * data.tau.std(0))
    before, after = predict(data), predict(data.replace(tau=data.tau + added))
    M = dynamics.mass_matrix(before.system.robot, data.q)
    acts = (M @ (after.mean - before.mean)[..., None])[..., 0]
    return ((acts * added).sum(0) / added.square().sum(0)).tolist()


def add_ratios(by_model: dict[str, dict]) -> None:
    """Ratios by joint of errors to those of least squares, and the geometric mean of those of torques."""
    for baseline in LEAST_SQUARES:
        reference = by_model[baseline]
        for found in by_model.values():
            ratio = {
                key: (torch.tensor(found[key]) / torch.tensor(reference[key])).tolist()
                for key in ("torque_rmse", "torque_rmse_one_mass_matrix", "acceleration_mse")
            }
            means = {
                f"{key}_geometric_mean": float(torch.tensor(ratio[key]).log().mean().exp())
                for key in ("torque_rmse", "torque_rmse_one_mass_matrix")
            }
            found[f"ratio_to_{baseline}"] = ratio | means


def run_case(case: Case) -> dict:
    """Fit every model and test it."""
    tests = {name: moving(data) for name, data in case.tests.items()}
    result: dict = {
        "training_samples": len(case.train),
        "test_samples": {name: len(data) for name, data in tests.items()},
        "fits": {},
        "tests": {name: {} for name in tests},
    }
    for name, fit in models(case).items():
        fitted = fit()
        result["fits"][name] = {"seconds": fitted.seconds, **fitted.notes}
        for test, data in tests.items():
            found = scores(fitted.predict(data), data, case.system.robot)
            found["torque_response"] = torque_response(fitted.predict, data)
            result["tests"][test][name] = found
        print(f"{case.name}: {name}, fitted in {fitted.seconds:.1f} s", flush=True)
    for by_model in result["tests"].values():
        add_ratios(by_model)
    if case.rollouts:
        result["rollouts"] = run_rollouts(case)
    return result


def numbers(values: list[float] | None, digits: int = 2) -> str:
    return "–" if values is None else " ".join(f"{value:.{digits}f}" for value in values)


def markdown(result: dict) -> str:
    """The tables of the page."""
    parts = [
        f"Measured on {result['machine']} with {result['cores']} cores, in {result['threads']} thread(s) "
        f"and {result['seconds']:.0f} s."
    ]
    baseline = f"ratio_to_{LEAST_SQUARES[0]}"
    in_motion = f"ratio_to_{LEAST_SQUARES[1]}"
    for case, found in result["cases"].items():
        for test, by_model in found["tests"].items():
            rows = [
                [
                    name,
                    numbers(row["torque_rmse"]),
                    f"{row[baseline]['torque_rmse_geometric_mean']:.2f}",
                    f"{row[in_motion]['torque_rmse_geometric_mean']:.2f}",
                    f"{row[baseline]['torque_rmse_one_mass_matrix_geometric_mean']:.2f}",
                    " ".join(f"{value:.3g}" for value in row[baseline]["acceleration_mse"]),
                    numbers(row.get("torque_coverage")),
                    numbers(row["torque_response"], 1),
                ]
                for name, row in by_model.items()
            ]
            parts += [f"### {case}: {test}", table(COLUMNS, rows)]
        if "rollouts" in found:
            parts += [f"### {case}: open loop", rollouts(found["rollouts"])]
    return "\n\n".join(parts)


def rollouts(found: dict) -> str:
    """The table of open-loop trajectories."""
    columns = ["model", *(f"joint angles after {h:g} s, RMSE [rad]" for h in found["horizons_s"])]
    names = ("least squares", NAME)
    rows = [[name, *(f"{error:.3f}" for error in found[name])] for name in names]
    share = found["coverage_of_90_%_bands"]
    text = f"{found['starts']} starts; the 90 % bands of {found['samples']} samples hold {share:.1%}."
    return table(columns, rows) + "\n\n" + text


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--logs", type=Path, default=LOGS, help="folder of the logs (default: ../shared/real)"
    )
    parser.add_argument("--case", choices=sorted(CASES), nargs="*", default=list(CASES))
    parser.add_argument("--json", type=Path, help="write all results to this file")
    parser.add_argument("--plots", type=Path, help="folder for one picture per test, a panel per joint")
    parser.add_argument("--docs", type=Path, help="write the tables into this Markdown file")
    options = parser.parse_args()
    torch.manual_seed(0)
    began = time.perf_counter()
    try:
        cases = [case for name in options.case for case in CASES[name](options.logs)]
    except DataError as error:
        sys.exit(str(error))
    result: dict = {
        "machine": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
    }
    result["cases"] = {case.name: run_case(case) for case in cases}
    result["seconds"] = time.perf_counter() - began
    print(markdown(result))
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    if options.plots is not None:
        for case, found in result["cases"].items():
            draw_errors(options.plots, case, found["tests"])
    if options.docs is not None:
        write_section(options.docs, "real_logs", markdown(result))


if __name__ == "__main__":
    main()
