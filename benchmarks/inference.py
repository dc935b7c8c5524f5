"""Speed and memory of inference, beside the dense nq·N formula with autograd, and the cost of whole fits.

    python benchmarks/inference.py --json result.json            # likelihood, prediction and fits, N = 1000
    python benchmarks/inference.py --samples 400 --no-fits

Each likelihood runs in a process of its own, so that peak memory is its own; ratios are of one run on one
machine. The data are a simulated minute of the paper's task.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import platform
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from results_page import table, write_section
from torch import Tensor

import forcegp
from forcegp.data import split_by_stretches
from forcegp.forces.priors.sets import PAPER, default_priors
from forcegp.forces.problem import Problem, kernel_parameters
from forcegp.forces.quantities import states
from forcegp.gp.likelihood import negative_log_likelihood
from forcegp.learning.search import initial
from forcegp.learning.specification import training_for
from forcegp.simulate import simulate

REPEATS = 3


def training_data(folder: Path, samples: int) -> tuple[forcegp.Dataset, forcegp.Dataset]:
    """Training and test rows of the simulated run, simulated once."""
    path = folder / "run.parquet"
    scene = forcegp.load_scene("kuka_plane")
    if not path.is_file():
        print("simulating a minute of motion", flush=True)
        simulate(scene.system(), scene.simulation).data.write(path)
    data = forcegp.Dataset.read(path)
    split = split_by_stretches(data, samples)
    return data[split.train], data[split.test]


def unfitted(mean: str = "zero") -> forcegp.StructuredGP:
    """A structured GP with default priors on the paper's task."""
    return forcegp.StructuredGP(forcegp.load_scene("kuka_plane").system(), mean=mean)


def start_of(data: forcegp.Dataset) -> tuple[forcegp.StructuredGP, Problem, dict[str, Tensor]]:
    system = forcegp.load_scene("kuka_plane").system()
    # The dense formula is the paper's, kernel included.
    model = forcegp.StructuredGP(system, "zero", force_priors=default_priors(system, "zero", PAPER))
    training, _ = training_for(model.specification, None, data, None)
    problem = model.specification.problem(training)
    return model, problem, initial(problem, learn_noise=False)


def projected(data: forcegp.Dataset) -> Callable[[], float]:
    """One likelihood with gradient, as this library computes it."""
    model, problem, start = start_of(data)
    blocks, constant = problem.fixed_rows.blocks, float(problem.fixed_rows.constant)

    def evaluate() -> float:
        leaves = {key: value.clone().requires_grad_() for key, value in kernel_parameters(start).items()}
        value = negative_log_likelihood(model.force_priors, leaves, blocks)
        torch.autograd.grad(value, list(leaves.values()))
        return float(value.detach()) + constant

    return evaluate


def dense(data: forcegp.Dataset) -> Callable[[], float]:
    """One likelihood with gradient by the paper's formula: einsum, nq·N rows, autograd through Cholesky."""
    model, problem, start = start_of(data)
    m, std = problem.training.measurements[0], problem.training.noise_std[0]
    at = states(model.system, m.q, m.qd, m.tau, m.active)
    prior, scale = model.force_priors[0], problem.training.scales[0]
    x = torch.cat(list(scale.apply(prior.features(model.system, at)).values()), dim=-1)
    H = at.eom.H
    y = (m.values - (at.eom.L @ at.eom.b[..., None])[..., 0]).reshape(-1)

    def evaluate() -> float:
        leaves = {key: value.clone().requires_grad_() for key, value in start.items()}
        a = x * torch.exp(-leaves["joint.log_lengthscale"])[:, None, :]
        r2 = torch.cdist(a, a, compute_mode="use_mm_for_euclid_dist").square()
        k = torch.exp(2.0 * leaves["joint.log_std"])[:, None, None] * torch.exp(-0.5 * r2)
        kQ = torch.diag_embed(k.permute(1, 2, 0))
        K = torch.einsum("iab,ijbc,jdc->iajd", H, kQ, H).reshape(len(y), len(y))
        L = torch.linalg.cholesky(K + torch.diag((std**2).repeat(len(x))))
        alpha = torch.cholesky_solve(y[:, None], L)[:, 0]
        value = 0.5 * y @ alpha + L.diagonal().log().sum() + 0.5 * len(y) * math.log(2.0 * math.pi)
        torch.autograd.grad(value, list(leaves.values()))
        return float(value.detach())

    return evaluate


def _measure(make: str, folder: str, samples: int, repeats: int, result: multiprocessing.Queue) -> None:
    data, _ = training_data(Path(folder), samples)
    evaluate = {"projected": projected, "dense": dense}[make](data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds, value = [], math.nan
    for _ in range(repeats):
        began = time.perf_counter()
        value = evaluate()
        seconds.append(time.perf_counter() - began)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    result.put({"seconds": seconds, "value": value, "peak_mib": (peak - before) / 1024})


def measure(make: str, folder: Path, samples: int, repeats: int) -> dict:
    """Seconds, value and peak memory above the start of one likelihood, in a process of its own."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=_measure, args=(make, str(folder), samples, repeats, queue))
    process.start()
    result = queue.get()
    process.join()
    return result


def median_seconds(call: Callable[[], object], repeats: int) -> float:
    call()
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds)


def likelihoods(folder: Path, samples: int) -> dict:
    """One likelihood with gradient, both ways, turn by turn."""
    training_data(folder, samples)
    ours, reference = (measure(name, folder, samples, REPEATS) for name in ("projected", "dense"))
    result = {
        "samples": samples,
        "seconds": min(ours["seconds"]),
        "dense_seconds": min(reference["seconds"]),
        "peak_mib": ours["peak_mib"],
        "dense_peak_mib": reference["peak_mib"],
        "relative_difference": abs(ours["value"] - reference["value"]) / abs(reference["value"]),
    }
    result["speed_ratio"] = result["dense_seconds"] / result["seconds"]
    result["memory_ratio"] = result["peak_mib"] / result["dense_peak_mib"]
    return result


def fit_and_predict(folder: Path, samples: int, mean: str) -> dict:
    """A whole fit to convergence, its errors on held-out stretches, and the cost of predictions."""
    train, test = training_data(folder, samples)
    model = unfitted(mean)
    began = time.perf_counter()
    fit = model.fit(train)
    fit_seconds = time.perf_counter() - began
    test = test[torch.linspace(0, len(test) - 1, 1000).round().long()]
    one = [x[:1] for x in (test.q, test.qd, test.tau)]
    many = (test.q, test.qd, test.tau)
    began = time.perf_counter()
    prediction = fit.predict(*many)
    all_seconds = time.perf_counter() - began
    clean, noisy = (prediction.mean - test.qdd_clean).abs(), (prediction.mean - test.qdd).abs()
    std = prediction.variance
    return {
        "samples": samples,
        "mean": mean,
        "fit_seconds": fit_seconds,
        "evaluations": fit.result.evaluations,
        "converged": fit.result.converged,
        "one_mean_ms": 1e3 * median_seconds(lambda: fit.predict(*one, covariance=False), 50),
        "one_covariance_ms": 1e3 * median_seconds(lambda: fit.predict(*one), 5),
        "thousand_seconds": all_seconds,
        "clean_mae": float(clean.mean()),
        "noisy_mae": float(noisy.mean()),
        "coverage_noisy": float((noisy < 2.0 * (std + 0.01).sqrt()).double().mean()),
        "coverage_clean": float((clean < 2.0 * std.sqrt()).double().mean()),
    }


def markdown(result: dict) -> str:
    """The section of the page of results."""
    one = result["likelihood"]
    rows = [
        [
            str(fit["samples"]),
            f"{fit['fit_seconds']:.1f} ({fit['evaluations']})",
            "yes" if fit["converged"] else "no",
            f"{fit['one_mean_ms']:.1f}",
            f"{fit['one_covariance_ms']:.1f}",
            f"{fit['thousand_seconds']:.2f}",
            f"{fit['clean_mae']:.4f}",
            f"{fit['coverage_noisy']:.3f}",
            f"{fit['coverage_clean']:.3f}",
        ]
        for fit in result["fits"]
    ]
    header = ["N", "fit [s] (evaluations)", "converged", "one mean [ms]", "one mean and covariance [ms]"]
    header += ["1000 means and covariances [s]", "clean error [rad/s²]", "±2 std holds noisy", "clean"]
    return "\n".join(
        [
            "## Inference",
            "",
            f"Zero-mean S-GP of the KUKA iiwa on the plane, float64, {result['machine']}, "
            f"{result['threads']} threads; `python benchmarks/inference.py --json FILE --docs "
            "benchmarks/notes/speed.md` measures it again.",
            "",
            f"One likelihood with gradient at N = {one['samples']}: {one['seconds']:.1f} s and "
            f"{one['peak_mib']:.0f} MiB, against {one['dense_seconds']:.1f} s and "
            f"{one['dense_peak_mib']:.0f} MiB for the dense nq·N formula with autograd: "
            f"{one['speed_ratio']:.1f} times as fast with {100 * one['memory_ratio']:.0f} % of the memory, "
            f"equal to {one['relative_difference']:.0e} relative.",
            "",
            "Whole fits to convergence, and predictions on held-out stretches:",
            "",
            table(header, rows),
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--fits", type=int, nargs="*", default=[200, 400, 1000])
    parser.add_argument("--no-fits", action="store_true")
    parser.add_argument("--mean", default="zero")
    parser.add_argument("--folder", type=Path, help="where the simulated run is kept, to be used again")
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    parser.add_argument("--docs", type=Path, help="write the tables into this Markdown file")
    options = parser.parse_args()
    with TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        result: dict = {
            "machine": platform.processor() or platform.machine(),
            "threads": torch.get_num_threads(),
        }
        result["likelihood"] = likelihoods(folder, options.samples)
        print(json.dumps(result["likelihood"], indent=2), flush=True)
        result["fits"] = []
        for samples in [] if options.no_fits else options.fits:
            result["fits"].append(fit_and_predict(folder, samples, options.mean))
            print(json.dumps(result["fits"][-1], indent=2), flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    if options.docs is not None:
        write_section(options.docs, "inference", markdown(result))


if __name__ == "__main__":
    main()
