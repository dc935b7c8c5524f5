"""Learning from noisy states: errors and coverage on the paper's task, with the noise stated or not.

    python benchmarks/state_noise.py --json result.json                # ten minutes of motion, three seeds
    python benchmarks/state_noise.py --duration 60 --samples 200 --seeds 0

Training samples are those of farthest point sampling; then q and q̇ get white noise. Predictions are made at
noise-free states of held-out stretches. Errors and `clean` coverage are against noise-free accelerations,
`noisy` coverage is of measured ones by the interval with the noise of the acceleration.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

import forcegp
from forcegp.data import split_by_stretches
from forcegp.simulate import simulate

Q_STD, QD_STD = 1e-3, 1e-2
"""Noise of the states [rad, rad/s]."""
WAYS = {"no noise": None, "not stated": None, "stated": (Q_STD, QD_STD)}
TEST_SAMPLES = 1000


def log_of(folder: Path, seed: int, duration: float) -> forcegp.Dataset:
    """A simulated run, from the folder if it is there."""
    path = folder / f"kuka_plane-{seed}-{duration:g}s.parquet"
    if not path.is_file():
        scene = forcegp.load_scene("kuka_plane")
        config = dataclasses.replace(scene.simulation, duration=duration, seed=seed)
        simulate(scene.system(), config).data.write(path)
    return forcegp.Dataset.read(path)


def with_noise(data: forcegp.Dataset, seed: int) -> forcegp.Dataset:
    """The samples with white noise on q and q̇."""
    generator = torch.Generator().manual_seed(100 + seed)
    dq, dqd = (torch.randn(data.q.shape, generator=generator, dtype=torch.float64) for _ in range(2))
    return data.replace(q=data.q + Q_STD * dq, qd=data.qd + QD_STD * dqd)


def run(data: forcegp.Dataset, seed: int, mean: str, samples: int, way: str) -> dict:
    """Errors and coverage of one fit."""
    split = split_by_stretches(data, samples, seed=seed)
    rows = split.test[torch.linspace(0, len(split.test) - 1, TEST_SAMPLES).round().long()]
    train, test = data[split.train], data[rows]
    noise_std = data.header.noise_std
    assert noise_std is not None and test.qdd_clean is not None
    system = forcegp.load_scene("kuka_plane").system()
    model = forcegp.StructuredGP(system, mean, noise=forcegp.Noise(state=WAYS[way]))
    fit = model.fit(train if way == "no noise" else with_noise(train, seed))
    found = fit.predict(test.q, test.qd, test.tau, active=test.active(system.contact_names))
    std = found.std
    assert std is not None
    error = (found.mean - test.qdd_clean).abs()
    noisy = (found.mean - test.qdd).abs() < 2.0 * (std**2 + noise_std**2).sqrt()
    return {
        "mean": mean,
        "samples": samples,
        "way": way,
        "seed": seed,
        "error": float(error.mean()),
        "clean": float((error < 2.0 * std).double().mean()),
        "noisy": float(noisy.double().mean()),
        "std": float(std.mean()),
        "evidence": fit.result.log_marginal_likelihood,
        "learned_slopes": fit.training.slopes is not None,
    }


def averages(results: list[dict]) -> str:
    """Rows of a table: averages over the seeds."""
    lines = ["| mean | N | | error [rad/s²] | clean | noisy |", "|---|---|---|---|---|---|"]
    for mean, samples, way in dict.fromkeys((r["mean"], r["samples"], r["way"]) for r in results):
        own = [r for r in results if (r["mean"], r["samples"], r["way"]) == (mean, samples, way)]
        error, clean, noisy = (statistics.fmean(r[key] for r in own) for key in ("error", "clean", "noisy"))
        lines.append(f"| {mean} | {samples} | {way} | {error:.4f} | {clean:.2f} | {noisy:.2f} |")
    return "\n".join(lines)


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--duration", type=float, default=600.0)
    parser.add_argument("--samples", type=int, nargs="+", default=[100, 200])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--means", nargs="+", default=["analytical", "zero"])
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--logs", type=Path, help="folder that keeps the simulated runs")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    results = []
    with TemporaryDirectory() as temporary:
        for seed in options.seeds:
            data = log_of(options.logs or Path(temporary), seed, options.duration)
            for mean in options.means:
                for samples in options.samples:
                    for way in options.ways:
                        results.append(run(data, seed, mean, samples, way))
                        print(json.dumps(results[-1]), flush=True)
    print(averages(results))
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
