"""Random fits over the bundled scenes and options, and whether their standard deviations are right.

    PYTHONPATH=tests python benchmarks/random_fits.py --json result.json            # about an hour
    PYTHONPATH=tests python benchmarks/random_fits.py --fits 20 --seed 3

Each fit draws a scene, a model, a number of samples, a noise, and now and then an outlier or accelerations
without noise. Counted by model: fits that raise an error or warn, predicted variances that are not positive,
coverage of measured accelerations by ±2σ, and, for fits of at most 80 samples without inducing points, the
largest relative error of σ beside a dense posterior in 80-bit arithmetic.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import random
from functools import cache
from pathlib import Path
from typing import Any

import torch

import forcegp
from extended import deviation_errors
from forcegp.errors import ForceGPError
from forcegp.evaluation import evaluate
from forcegp.forces.quantities import affine_map, states_at
from forcegp.models.registry import create
from forcegp.models.structured_fit import StructuredFit
from forcegp.scene import BUNDLED
from forcegp.simulate import simulate

MODELS = ("sgp-zero", "sgp-mean", "sgp", "sgp-contact", "sgp-zero-se", "sgp-mean-se", "gp")
SIZES = (20, 30, 40, 60, 80, 150, 300, 600)
WEIGHTS = (3, 3, 3, 3, 3, 3, 2, 1)
LARGEST_REFERENCE = 80
TESTS, REFERENCES = 300, 5
DURATION = 12.0
"""Of each log [s]; the last quarter is for tests."""


@cache
def log_of(name: str, seed: int) -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset]:
    scene = forcegp.load_scene(name)
    config = dataclasses.replace(scene.simulation, duration=DURATION, seed=seed)
    return scene.system(), simulate(scene.system(), config).data


def drawn(chance: random.Random) -> dict[str, Any]:
    """What one fit is made of."""
    case: dict[str, Any] = {
        "scene": chance.choice(BUNDLED),
        "seed": chance.randrange(2),
        "model": chance.choice(MODELS),
        "samples": chance.choices(SIZES, WEIGHTS)[0],
        "rows": chance.randrange(2**31),
        "special": chance.choices(("", "outlier", "clean"), (8, 1, 1))[0],
        "options": {},
    }
    structured, noise = case["model"] != "gp", {}
    if chance.random() < 0.3:
        noise["acceleration"] = 10.0 ** chance.uniform(-4.0, 0.5)
    if structured and chance.random() < 0.2:
        noise["learn"] = True
    if structured and chance.random() < 0.2:
        case["options"]["inference"] = "sparse"
    if structured and chance.random() < 0.1:
        noise["degrees_of_freedom"] = 4.0
    if noise:
        case["options"]["noise"] = noise
    return case


def run(case: dict[str, Any]) -> dict[str, Any]:
    """Fit and test one case."""
    system, log = log_of(case["scene"], case["seed"])
    split = len(log) * 3 // 4
    generator = torch.Generator().manual_seed(case["rows"])
    rows = torch.randperm(split, generator=generator)[: case["samples"]].sort().values
    train, test = log[rows], log[split :: max(1, (len(log) - split) // TESTS)]
    if case["special"] == "outlier":
        qdd = train.qdd.clone()
        qdd[len(qdd) // 2, 0] = 10.0 ** random.Random(case["rows"]).uniform(2.0, 9.0)
        train = dataclasses.replace(train, qdd=qdd)
    if case["special"] == "clean":
        train = dataclasses.replace(train, qdd=train.extras["qdd_clean"])
    result: dict[str, Any] = {**case, "error": None}
    try:
        options = {**case["options"], "noise": forcegp.Noise(**case["options"].get("noise", {}))}
        fit = create(case["model"], system, **options).fit(train)
        result |= {"converged": fit.result.converged, "warnings": list(fit.result.warnings)}
        result |= {"evaluations": fit.result.evaluations, "objective": fit.result.objective}
        result["not_positive"] = sum(_not_positive(fit, part) for part in (train, test))
        result["coverage"] = evaluate(fit, test, compare=False).uncertainty.coverage_noisy
        if _comparable(fit, case):
            near, far = train[:REFERENCES], test[:: len(test) // REFERENCES]
            result["deviation"] = deviation_errors(fit, forcegp.Dataset.concatenate([near, far]))
    except ForceGPError as error:
        result["error"] = f"{type(error).__name__}: {error.message}"
    return result


def _not_positive(fit: Any, data: forcegp.Dataset) -> int:
    """Number of states with a variance that is not positive where a prior acts: one on the friction of a
    contact does not where the contact is open."""
    closed = data.active(fit.system.contact_names)
    prediction = fit.predict(data.q, data.qd, data.tau, active=closed)
    bad = (prediction.variance <= 0.0).any(-1)
    if isinstance(fit, StructuredFit) and bool(bad.any()):
        at, _ = states_at(fit.system, data.q[bad], data.qd[bad], data.tau[bad], closed[bad])
        rows = fit.posterior.rows(fit.system, at, affine_map(fit.system, at, "qdd"))
        return int(torch.stack([W.flatten(1).any(-1) for W in rows.operators]).any(0).sum())
    return int(bad.sum())


def _comparable(fit: Any, case: dict[str, Any]) -> bool:
    if not isinstance(fit, StructuredFit) or case["samples"] > LARGEST_REFERENCE:
        return False
    return fit.result.inference == "exact" or all(p.kernel.is_finite for p in fit.posterior.priors)


def line(name: str, own: list[dict[str, Any]]) -> str:
    """One row of the table."""
    fitted = [r for r in own if r["error"] is None]
    covered = [r["coverage"] for r in fitted if r["coverage"] is not None]
    errors = [r["deviation"] for r in fitted if "deviation" in r]
    numbers = (
        f"{len(own):5d} {len(own) - len(fitted):7d} {sum(bool(r['warnings']) for r in fitted):7d} "
        f"{sum(not r['converged'] for r in fitted):8d} {sum(r['not_positive'] > 0 for r in fitted):6d}"
    )
    coverage = f"{sum(covered) / len(covered):9.2f}" if covered else f"{'-':>9}"
    worst = f"{len(errors):9d} {max(errors):9.1e}" if errors else f"{0:9d} {'-':>9}"
    return f"{name:12} {numbers} {coverage} {worst}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fits", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    chance, results = random.Random(arguments.seed), []
    for k in range(arguments.fits):
        results.append(run(drawn(chance)))
        print(k, json.dumps(results[-1]), flush=True)
        if arguments.json:
            arguments.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    columns = " fits  errors  warned stopped σ = 0  coverage  compared     worst"
    print(f"\n{'model':12} {columns}")
    for name in MODELS:
        print(line(name, [r for r in results if r["model"] == name]))
    print(line("all", results))


if __name__ == "__main__":
    main()
