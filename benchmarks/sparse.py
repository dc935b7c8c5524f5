"""Sparse posterior: each bound on time, memory and accuracy beside what is measured.

    python benchmarks/sparse.py --json result.json                      # everything, a quarter of an hour
    python benchmarks/sparse.py --section stream predict      # synthetic rows only
    python benchmarks/sparse.py --logs FOLDER                           # keep the simulated logs there

Each measurement runs in a process of its own, with one thread, so that peak memory is its own; ratios are of
one run on one machine.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import platform
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import sparse_logs
import sparse_rows
import torch
from results_page import table, write_section

SEEDS = (0, 1, 2)
REAL = Path(__file__).resolve().parents[2] / "shared" / "real"
ERROR = {"sgp-zero": 0.005, "sgp-mean": 0.0025, "sgp-contact": 0.001}
"""Largest error against noise-free accelerations on held-out stretches, after ten minutes [rad/s²]."""


@dataclass(frozen=True)
class Bound:
    """A measurement beside what it must not be below or above."""

    what: str
    measured: float
    unit: str = ""
    least: float = -math.inf
    most: float = math.inf

    @property
    def met(self) -> bool:
        """Whether it is within its bounds."""
        return self.least <= self.measured <= self.most

    def row(self) -> list[str]:
        """Cells of a table."""
        limits = [f"≥ {self.least:g}"] if math.isfinite(self.least) else []
        limits += [f"≤ {self.most:g}"] if math.isfinite(self.most) else []
        met = ("yes" if self.met else "no") if limits else ""
        return [self.what, f"{self.measured:.3g}", ", ".join(limits), self.unit, met]


def _call(function: Callable[..., dict], arguments: tuple, results: Any) -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    results.put(function(*arguments))


def alone(function: Callable[..., dict], *calls: tuple) -> list[dict]:
    """Results of calls, each in a process of its own, at the same time."""
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    processes = [context.Process(target=_call, args=(function, call, results)) for call in calls]
    for process in processes:
        process.start()
    found = [results.get() for _ in processes]
    for process in processes:
        process.join()
    return found


def stream(options: argparse.Namespace) -> tuple[object, list[Bound]]:
    """Time and memory against the number of samples."""
    runs = [alone(sparse_rows.conditioning, (samples,))[0] for samples in options.samples]
    first, last = runs[0], runs[-1]
    bounds = [
        Bound(f"{last['samples']:,} samples", last["seconds"], "s", most=240.0),
        Bound("peak memory", last["peak_mib"], "MiB", most=2048.0),
    ]
    if len(runs) > 1:
        rates = [run["processor_seconds"] / run["samples"] for run in (first, last)]
        apart = last["peak_mib"] - first["peak_mib"]
        bounds.append(Bound("time per sample, last to first", rates[1] / rates[0], most=1.2))
        bounds.append(Bound("peak memory, last less first", apart, "MiB", most=50.0))
    return runs, bounds


def predict(options: argparse.Namespace) -> tuple[object, list[Bound]]:
    """Predictions, and updates of the posterior with the rows of one sample."""
    found = alone(sparse_rows.predictions, (min(options.samples),))[0]
    limits = {
        "one_mean_ms": ("mean of one state", 0.5),
        "one_mean_and_covariance_ms": ("mean and covariance of one state", 1.5),
        "thousand_covariances_ms": ("covariances of 1000 states", 300.0),
        "update_one_sample_ms": (f"update with one sample, {found['basis_functions']} basis functions", 2.0),
    }
    return found, [Bound(what, found[key]["wall"], "ms", most=most) for key, (what, most) in limits.items()]


def accuracy(options: argparse.Namespace) -> tuple[object, list[Bound]]:
    """Ten-minute logs, all training samples, held-out stretches."""
    runs, bounds = [], []
    for seed in SEEDS:
        for name, error in ERROR.items():
            found = alone(sparse_logs.accuracy, (options.logs, name, seed))[0]
            print(json.dumps(found), flush=True)
            label = f"{name}, seed {seed}: "
            runs.append(found)
            bounds += [
                Bound(label + "clean error", found["clean_error"], "rad/s²", most=error),
                Bound(label + "noisy coverage", found["coverage_noisy"], least=0.94, most=0.96),
                Bound(label + "clean coverage", found["coverage_clean"], least=0.85),
            ]
    return runs, bounds


def exact(options: argparse.Namespace) -> tuple[object, list[Bound]]:
    """Conditioning on all samples of a log against an exact fit to a thousand."""
    found = alone(sparse_logs.against_exact, (options.logs,))[0]
    label = f"{found['samples']:,} samples against an exact fit to {found['exact_samples']}"
    return found, [Bound(label, found["ratio"], most=0.1)]


def rollout(options: argparse.Namespace) -> tuple[object, list[Bound]]:
    """Function samples over ten seconds."""
    found = alone(sparse_logs.trajectories, (options.logs,))[0]
    return found, [Bound(f"{found['trajectories']} trajectories of 10 s", found["seconds"], "s", most=15.0)]


def update(options: argparse.Namespace) -> tuple[object, list[Bound]]:
    """Updates of a whole model; the bound is on one sample, ten and the posterior alone stand beside it."""
    found = alone(sparse_logs.updates, (options.logs,))[0]
    size = f"{found['basis_functions']} basis functions"
    return found, [
        Bound(f"fit.update with one sample, {size}", found["update_1_ms"]["wall"], "ms", most=2.0),
        Bound(f"fit.update with ten samples, {size}", found["update_10_ms"]["wall"], "ms"),
        Bound(f"posterior.updated with one sample, {size}", found["posterior_ms"]["wall"], "ms"),
    ]


def real(options: argparse.Namespace) -> tuple[object, list[Bound]]:
    """All samples of a real log against few."""
    found = alone(sparse_logs.real, (options.real,))[0]
    few = found["few"]["miscoverage"]
    label = f"real log, {found['samples']:,} samples against {found['few_samples']}: "
    return found, [
        Bound(label + "torque error", found["torque_rmse_ratio"], most=1.0),
        Bound(label + "mean distance of coverage from 0.954", found["all"]["miscoverage"], most=few + 0.005),
    ]


SECTIONS = {
    section.__name__: section for section in (stream, predict, update, rollout, accuracy, exact, real)
}


def markdown(machine: str, bounds: Sequence[Bound]) -> str:
    """The section of the page of results."""
    text = (
        "`python benchmarks/sparse.py --docs benchmarks/notes/speed.md` measures it again: one thread, "
        f"float64, {machine}. "
        "Synthetic rows are seven per sample; ten-minute logs are those of the paper's task."
    )
    rows = table(["what", "measured", "bound", "unit", "met"], [bound.row() for bound in bounds])
    return f"## Sparse posterior\n\n{text}\n\n{rows}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--section", choices=sorted(SECTIONS), nargs="*", default=list(SECTIONS))
    parser.add_argument("--samples", type=int, nargs="*", default=[100_000, 1_000_000], help="synthetic rows")
    parser.add_argument("--logs", type=Path, help="folder of the simulated logs, which are made if missing")
    parser.add_argument("--real", type=Path, default=REAL, help="folder of the real logs")
    parser.add_argument("--json", type=Path, help="write all results to this file")
    parser.add_argument("--docs", type=Path, help="write the table into this Markdown file")
    options = parser.parse_args()
    machine = platform.processor() or platform.machine()
    result: dict = {"machine": machine, "threads": 1, "bounds": []}
    bounds: list[Bound] = []
    with tempfile.TemporaryDirectory() as temporary:
        options.logs = options.logs or Path(temporary)
        options.logs.mkdir(parents=True, exist_ok=True)
        for name in options.section:
            result[name], own = SECTIONS[name](options)
            bounds += own
            for bound in own:
                print(f"{name}:", "; ".join(cell for cell in bound.row() if cell), flush=True)
            result["bounds"] += [
                {k: v for k, v in asdict(bound).items() if v not in (math.inf, -math.inf)}
                | {"met": bound.met}
                for bound in own
            ]
            if options.json is not None:
                options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    if options.docs is not None:
        write_section(options.docs, "sparse", markdown(machine, bounds))


if __name__ == "__main__":
    main()
