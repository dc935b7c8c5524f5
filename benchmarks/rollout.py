"""Speed and memory of rollouts with a structured GP on the paper's task.

    python benchmarks/rollout.py --json result.json

Ten seconds at 240 Hz from a simulated state: the mean trajectory, and 100 function samples at once. The model
is conditioned on `--points` simulated points with hyperparameters learned from 100 of them.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import time
from pathlib import Path

import torch

from forcegp.data.selection import select_points
from forcegp.models.base import Model
from forcegp.models.structured_gp import StructuredGP
from forcegp.rollout import RolloutOptions
from forcegp.scene import load_scene
from forcegp.simulate import SimulationConfig, SimulationResult, simulate

TARGETS = {0: 5.0, 100: 60.0}
"""Seconds that a rollout of ten seconds may take, by number of samples."""
MEBIBYTE = 2**20


def model_and_run(points: int, seconds: float) -> tuple[Model, SimulationResult]:
    """A model conditioned on simulated points, and another run to start from."""
    system = load_scene("kuka_plane").system()
    train = simulate(system, SimulationConfig(duration=max(10.0, points / 100.0), seed=1)).data
    chosen = train[select_points(train, points)]
    model = StructuredGP(system, mean="analytical", noise_std=0.1)
    model.fit(chosen[:100])
    model.condition(chosen)
    return model, simulate(system, SimulationConfig(duration=seconds + 0.1, seed=2))


def measure(model: Model, run: SimulationResult, seconds: float, samples: int) -> dict[str, float]:
    """Wall and processor time of one rollout, the growth of memory, and what its result holds."""
    data = run.data
    options = RolloutOptions(on_divergence="keep")
    model.rollout(data.q[0], data.qd[0], data.tau, 0.05, samples, options=options)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wall, processor = time.perf_counter(), time.process_time()
    path = model.rollout(data.q[0], data.qd[0], data.tau, seconds, samples, options=options)
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    parts = [path] if path.samples is None else [path, path.samples]
    names = ("q", "qd", "qdd", "tau", "multiplier", "c", "cd", "active")
    stored = sum(getattr(p, n).nbytes for p in parts for n in names)
    return {
        "samples": samples,
        "seconds_simulated": seconds,
        "wall_s": wall,
        "processor_s": processor,
        "target_s": TARGETS[samples] * seconds / 10.0,
        "ms_per_step": 1e3 * wall / (len(path.t) - 1),
        "stored_MiB": stored / MEBIBYTE,
        "peak_growth_MiB": (after - before) * 1024 / MEBIBYTE,
        "drift_m": max(float(p.drift.nan_to_num(0.0).abs().max()) for p in parts),
        "diverged": sum(len(p.diverged) for p in parts),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    model, run = model_and_run(args.points, args.seconds)
    with torch.no_grad():
        rows = [measure(model, run, args.seconds, samples) for samples in TARGETS]
    machine = f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}"
    result = {"machine": machine, "threads": args.threads, "points": args.points, "rollouts": rows}
    for row in rows:
        print(", ".join(f"{name} {value:.4g}" for name, value in row.items()))
    if args.json is not None:
        args.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
