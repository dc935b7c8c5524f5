"""Open-loop trajectories on a real log: structured GP beside least squares, and coverage of its bands."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from real_cases import Case
from torch import Tensor

import forcegp
from forcegp.constraints import ConstrainedSystem
from forcegp.evaluation.least_squares import LeastSquares, identify_rigid
from forcegp.forces.quantities import States
from forcegp.rollout import ForceField, compare

HORIZONS = (0.5, 1.0)
"""Times at which joint angles are compared [s]."""
NAME = "structured GP, defaults"
STARTS, SAMPLES = 40, 50
LEAST_SPEED = 0.5
"""The log is used up to the last sample in which a joint is faster [rad/s]."""


@dataclass(frozen=True)
class Rigid:
    """An identified robot as a model that can be rolled out."""

    found: LeastSquares
    kind: str = "least squares"
    has_function_samples: bool = False
    disturbance: None = None

    @property
    def system(self) -> ConstrainedSystem:
        return self.found.system

    def force_field(self) -> ForceField:
        def force(system: ConstrainedSystem, at: States) -> Tensor:
            return at.eom.Q_K + at.tau - self.found.losses(at.qd)

        return force

    def force_samples(self, samples: int, generator: torch.Generator) -> ForceField:
        raise NotImplementedError

    def predict(self, *_: object, **__: object):
        raise NotImplementedError


def run_rollouts(case: Case) -> dict:
    """Root-mean-square errors of joint angles [rad] by model and horizon, and coverage of the 90 % bands."""
    models = {
        "least squares": Rigid(identify_rigid(case.system, case.train)),
        NAME: forcegp.StructuredGP(case.system, "analytical").fit(case.train),
    }
    log = next(iter(case.tests.values()))
    log = log[: int((log.qd.abs().amax(-1) > LEAST_SPEED).nonzero().max())]
    found = compare(models, log, max(HORIZONS), STARTS, SAMPLES, system=case.system)
    result: dict = {"horizons_s": HORIZONS, "starts": STARTS, "samples": SAMPLES}
    for name, path in found.predicted.items():
        error = path.q - found.q
        at = [int((found.t - horizon).abs().argmin()) for horizon in HORIZONS]
        result[name] = [float(error[:, i].square().mean().sqrt()) for i in at]
    samples = found.predicted[NAME].samples
    assert samples is not None
    low, high = samples.q.quantile(0.05, 0), samples.q.quantile(0.95, 0)
    result["coverage_of_90_%_bands"] = float(((found.q >= low) & (found.q <= high)).double().mean())
    return result
