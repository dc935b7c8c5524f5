"""Speed, memory and drift of rollouts with a structured GP on the paper's task.

    python benchmarks/rollout.py --json result.json --docs benchmarks/notes/speed.md

Ten seconds at 240 Hz from a simulated state: the mean trajectory, and 100 function samples at once, with a
model that is conditioned on `--points` simulated points; the same over half the time, which shows how memory
grows with length. Then the largest constraint error over ten seconds under the simulator's controller (closed
loop) and under the simulated torques (open loop), by method and stabilization, from a state on the surface.
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
from results_page import table, write_section
from torch import Tensor

from forcegp.constraints import project_state
from forcegp.control.plan import make_plan
from forcegp.data import Dataset, select_points
from forcegp.models.structured_fit import StructuredFit
from forcegp.models.structured_gp import StructuredGP
from forcegp.rollout import RolloutOptions, TaskSpaceControl
from forcegp.scene import load_scene
from forcegp.simulate import SimulationConfig, SimulationResult, simulate

TARGETS = {0: 5.0, 100: 60.0}
"""Seconds that a rollout of ten seconds may take, by number of samples."""
MEBIBYTE = 2**20
DRIFT_POINTS = 200
"""Training points of the model whose drift is measured."""
DRIFT = [
    ("none", "semi_implicit_euler", 0),
    ("none", "rk4", 0),
    ("baumgarte", "semi_implicit_euler", 100),
    ("baumgarte", "rk4", 100),
    ("projection", "semi_implicit_euler", 100),
]
"""Stabilization, method, and function samples beside the mean."""


def model_and_run(points: int, seconds: float) -> tuple[StructuredFit, Dataset, SimulationResult]:
    """A model conditioned on simulated points, those points, and another run to start from."""
    system = load_scene("kuka_plane").system()
    train = simulate(system, SimulationConfig(duration=max(10.0, points / 20.0), seed=1)).data
    chosen = train[select_points(train, points)]
    fit = StructuredGP(system, mean="analytical", noise=0.1).fit(chosen[:DRIFT_POINTS])
    return fit.condition(chosen), chosen, simulate(system, _test_run(seconds))


def _test_run(seconds: float) -> SimulationConfig:
    return SimulationConfig(duration=seconds + 0.1, seed=2)


def measure(model: StructuredFit, run: SimulationResult, seconds: float, samples: int) -> dict[str, float]:
    """Wall and processor time of one rollout, the growth of memory, and what its result holds."""
    data = run.data
    options = RolloutOptions(on_divergence="keep")
    model.rollout(data.q[0], data.qd[0], data, 0.05, samples, options=options)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wall, processor = time.perf_counter(), time.process_time()
    path = model.rollout(data.q[0], data.qd[0], data, seconds, samples, options=options)
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
        "drift_m": max(_largest(p.drift) for p in parts),
        "diverged": sum(len(p.diverged) for p in parts),
    }


def drift(model: StructuredFit, run: SimulationResult, seconds: float) -> list[dict[str, float | str]]:
    """Largest |c(q)| by loop, stabilization and method, with the speed that the joints come to [m, rad/s]."""
    data, system, config = run.data, model.system, _test_run(seconds)
    plan = make_plan(system, config, torch.Generator().manual_seed(config.seed))
    control = TaskSpaceControl(system, plan, config.dt, config.gains)
    q0, qd0 = project_state(system, data.q[0], data.qd[0])
    rows = []
    for loop, inputs in (("closed", control), ("open", data)):
        for stabilization, method, samples in DRIFT:
            options = RolloutOptions(method=method, stabilization=stabilization, on_divergence="keep")
            path = model.rollout(q0, qd0, inputs, seconds, samples, options=options)
            figures = {"c_m": _largest(path.drift), "speed_rad_s": float(path.qd.abs().max())}
            if path.samples is not None:
                figures |= {"samples_c_m": _largest(path.samples.drift), "lost": len(path.samples.diverged)}
            rows.append({"loop": loop, "stabilization": stabilization, "method": method, **figures})
    return rows


def _largest(drift: Tensor) -> float:
    return float(drift.nan_to_num(0.0).abs().max())


def docs_section(result: dict) -> str:
    """The results as a section of the docs."""
    heads = {
        "samples": lambda r: str(r["samples"] or "mean"),
        "simulated [s]": lambda r: f"{r['seconds_simulated']:g}",
        "time [s]": lambda r: f"{r['wall_s']:.1f}",
        "target [s]": lambda r: f"{r['target_s']:g}",
        "result [MiB]": lambda r: f"{r['stored_MiB']:.1f}",
        "peak growth [MiB]": lambda r: f"{r['peak_growth_MiB']:.0f}",
        "largest drift [m]": lambda r: f"{r['drift_m']:.1e}",
    }
    speed = [[cell(r) for cell in heads.values()] for r in result["rollouts"]]
    drifts = [
        [
            *(r[key] for key in ("loop", "stabilization", "method")),
            f"{r['c_m']:.1e}",
            f"{r['samples_c_m']:.1e}" if "samples_c_m" in r else "–",
        ]
        for r in result["drift"]
    ]
    return "\n\n".join(
        [
            "## Rollouts",
            f"`python benchmarks/rollout.py --docs benchmarks/notes/speed.md` on {result['machine']}, "
            f"{result['threads']} threads; analytical mean, {result['points']} points, 240 Hz.",
            table(list(heads), speed),
            f"Largest constraint error over {result['seconds']:g} s ({DRIFT_POINTS} points, from a state on "
            "the surface):",
            table(["loop", "stabilization", "method", "mean [m]", "100 samples [m]"], drifts),
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--docs", type=Path, help="Markdown file whose section on rollouts is written.")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    model, chosen, run = model_and_run(args.points, args.seconds)
    spans = (0.5 * args.seconds, args.seconds)
    with torch.no_grad():
        rows = [measure(model, run, seconds, samples) for samples in TARGETS for seconds in spans]
        model = model.condition(chosen[:DRIFT_POINTS])
        drifts = drift(model, run, args.seconds)
    result = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}",
        "threads": args.threads,
        "points": args.points,
        "seconds": args.seconds,
        "rollouts": rows,
        "drift": drifts,
    }
    for row in [*rows, *drifts]:
        print(", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
    if args.json is not None:
        args.json.write_text(json.dumps(result, indent=2) + "\n")
    if args.docs is not None:
        write_section(args.docs, "rollout", docs_section(result))


if __name__ == "__main__":
    main()
