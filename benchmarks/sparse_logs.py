"""Sparse models on simulated logs of ten minutes, and on a real log."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import torch
from real_cases import CASES, moving
from real_logs import scores
from real_models import FEW, structured
from sparse_rows import median_ms

from forcegp.data import Dataset, complement, split_by_stretches
from forcegp.evaluation import evaluate
from forcegp.models import Inference
from forcegp.models.registry import create
from forcegp.models.structured_fit import StructuredFit
from forcegp.models.structured_gp import StructuredGP
from forcegp.scene import load_scene
from forcegp.simulate import simulate

MODELS = ("sgp-zero", "sgp-mean", "sgp-contact")
SECONDS, STRETCH, NOISE = 600.0, 3.0, 0.1
"""Simulated motion [s], duration of a held-out stretch [s], noise of accelerations [rad/s²]."""
TESTED, EXACT = 2000, 1000
"""Test samples, evenly spaced over all that are held out; training samples of the exact fit."""
UPDATE_POINTS = 70
"""Inducing points of one prior with which a model on the plane has about 500 basis functions."""
UPDATE_SIZES = (1, 10)
"""Samples that a model is updated with at a time."""


def simulated(folder: Path, seed: int) -> Path:
    """A ten-minute log of the paper's task, simulated where the folder does not hold it."""
    path = folder / f"kuka_plane_{seed}.parquet"
    if not path.exists():
        scene = load_scene("kuka_plane")
        config = dataclasses.replace(scene.simulation, duration=SECONDS, seed=seed, noise_std=NOISE)
        simulate(scene.system(), config).data.write(path)
    return path


def parts(folder: Path, seed: int) -> tuple[Dataset, Dataset]:
    """All samples to train on, and some of the held-out stretches."""
    data = Dataset.read(simulated(folder, seed))
    split = split_by_stretches(data, 1, stretch=STRETCH, method="random", seed=seed)
    rows = split.test[torch.linspace(0, len(split.test) - 1, TESTED).round().long()]
    return data[complement(split.test, len(data))], data[rows]


def accuracy(folder: Path, name: str, seed: int) -> dict:
    """Errors and coverage on held-out stretches of a model of all other samples."""
    train, test = parts(folder, seed)
    model = create(name, load_scene("kuka_plane").system(), noise=NOISE)
    began, used = time.perf_counter(), time.process_time()
    fit = model.fit(train)
    seconds, processor = time.perf_counter() - began, time.process_time() - used
    found = evaluate(fit, test, compare=False)
    return {
        "model": name,
        "seed": seed,
        "samples": len(train),
        "clean_error": found.clean.mae,
        "coverage_clean": found.uncertainty.coverage_clean,
        "coverage_noisy": found.uncertainty.coverage_noisy,
        "fit_seconds": seconds,
        "fit_processor_seconds": processor,
        "basis_functions": fit.result.basis_functions,
    }


def against_exact(folder: Path) -> dict:
    """Seconds of conditioning on all samples, and of an exact fit to a thousand of them."""
    train, _ = parts(folder, 0)
    few = train[torch.linspace(0, len(train) - 1, EXACT).round().long()]
    model = StructuredGP(load_scene("kuka_plane").system(), "analytical", noise=NOISE)
    began, used = time.perf_counter(), time.process_time()
    fit = model.fit(few)
    exact, exact_processor = time.perf_counter() - began, time.process_time() - used
    began, used = time.perf_counter(), time.process_time()
    result = fit.condition(train).result
    seconds, processor = time.perf_counter() - began, time.process_time() - used
    return {
        "samples": len(train),
        "basis_functions": result.basis_functions,
        "exact_samples": EXACT,
        "exact_seconds": exact,
        "exact_processor_seconds": exact_processor,
        "seconds": seconds,
        "processor_seconds": processor,
        "ratio": seconds / exact,
        "ratio_of_processor_time": processor / exact_processor,
    }


def _sparse(train: Dataset, points: int = 100) -> StructuredFit:
    """A sparse model of a thousand samples around the analytical mean, learned on 200 of them."""
    few = train[torch.linspace(0, len(train) - 1, EXACT).round().long()]
    model = StructuredGP(
        load_scene("kuka_plane").system(),
        "analytical",
        noise=NOISE,
        inference=Inference("sparse", inducing_points=points),
    )
    return model.fit(few[::5]).condition(few)


def trajectories(folder: Path) -> dict:
    """Seconds of 100 function samples over ten seconds at 240 Hz, and of the mean beside them."""
    train, _ = parts(folder, 0)
    model, run = _sparse(train), train[:2500]
    model.rollout(run.q[0], run.qd[0], run, 10.0)
    began, used = time.perf_counter(), time.process_time()
    path = model.rollout(run.q[0], run.qd[0], run, 10.0, 100)
    seconds, processor = time.perf_counter() - began, time.process_time() - used
    assert path.samples is not None
    return {
        "basis_functions": model.result.basis_functions,
        "trajectories": len(path.samples.q),
        "seconds": seconds,
        "processor_seconds": processor,
    }


def updates(folder: Path) -> dict:
    """Milliseconds of `fit.update` with one sample and with ten, equations of motion and whitening
    included, and of what of it is the posterior."""
    train, _ = parts(folder, 0)
    model = _sparse(train, UPDATE_POINTS)
    found: dict = {"basis_functions": model.result.basis_functions}
    for size in UPDATE_SIZES:
        samples = [train[first : first + size] for first in range(0, 100 * size, size)]
        found[f"update_{size}_ms"] = median_ms(lambda: model.update(samples.pop()), 60)  # noqa: B023
    fit = model
    one = dataclasses.replace(fit.problem, training=fit.problem.training.evenly(1))
    rows = one.rows(fit.hyperparameters).blocks
    found["posterior_ms"] = median_ms(lambda: fit.posterior.latent.updated(rows), 60)
    return found


def real(logs: Path) -> dict:
    """Torque errors and coverage on held-out segments of a KUKA iiwa14, learned from all samples and few."""
    case = CASES["iiwa14"](logs)[0]
    name, test = next(iter(case.tests.items()))
    test = moving(test)
    found = {}
    for label, samples in (("all", None), ("few", FEW)):
        errors = scores(structured(case, samples).predict(test), test, case.system.robot)
        coverage = torch.tensor(errors["torque_coverage"])
        found[label] = {
            "torque_rmse": errors["torque_rmse"],
            "torque_coverage": errors["torque_coverage"],
            "miscoverage": float((coverage - 0.9545).abs().mean()),
        }
    all_rmse, few_rmse = (torch.tensor(found[label]["torque_rmse"]) for label in ("all", "few"))
    return found | {
        "test": name,
        "samples": len(case.train),
        "few_samples": FEW,
        "torque_rmse_ratio": float((all_rmse / few_rmse).log().mean().exp()),
    }
