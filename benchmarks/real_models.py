"""The models that are compared on real logs, each fitted in one call."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from real_cases import Case, evenly, moving
from torch import Tensor

import forcegp
from forcegp.evaluation.least_squares import LeastSquares, identify_rigid
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.models.minibatch import BatchOptions
from forcegp.models.structured_fit import StructuredFit

GP_SAMPLES, NETWORK_SAMPLES, NETWORK_EPOCHS = 200, 5000, 200
"""Training samples, evenly spaced among those in motion, of the models that are blind to mechanics."""
FEW = 400
"""Training samples, evenly spaced among those in motion, of a structured GP that does not see all."""
CHUNK = 1000
"""States predicted at a time."""
LEAST_SQUARES = ("least squares", "least squares, in motion")


@dataclass(frozen=True)
class Predicted:
    """Accelerations `(n, nq)`, their covariance if any, and the robot that turns them into torques."""

    mean: Tensor
    covariance: Tensor | None
    system: forcegp.ConstrainedSystem


Predictor = Callable[[forcegp.Dataset], Predicted]


@dataclass(frozen=True)
class Fitted:
    """A model that predicts, and how its fit went."""

    predict: Predictor
    seconds: float
    notes: dict = field(default_factory=dict)
    fit: StructuredFit | None = None


def rigid(identify: Callable[[], LeastSquares]) -> Fitted:
    """An identified robot as a predictor."""
    began = time.perf_counter()
    found = identify()
    seconds = time.perf_counter() - began
    return Fitted(lambda data: Predicted(found.predict(data), None, found.system), seconds)


def constant(case: Case) -> Fitted:
    """The mean acceleration of the training log, whatever the state."""
    mean = moving(case.train).qdd.mean(0)
    return Fitted(lambda data: Predicted(mean.expand_as(data.qdd), None, case.system), 0.0)


def structured(case: Case, samples: int | None = None, priors: Sequence[ForcePrior] | None = None) -> Fitted:
    """The structured GP with the priors that the log asks for, or with given ones."""
    train = case.train if samples is None else evenly(moving(case.train), samples)
    fit = forcegp.StructuredGP(case.system, "analytical", force_priors=priors).fit(train)

    def predict(data: forcegp.Dataset) -> Predicted:
        parts = [
            fit.predict(part.q, part.qd, part.tau, noise=True)
            for part in (data[i : i + CHUNK] for i in range(0, len(data), CHUNK))
        ]
        covariance = torch.cat([part.covariance for part in parts if part.covariance is not None])
        return Predicted(torch.cat([part.mean for part in parts]), covariance, fit.system)

    result = fit.result
    notes = {
        "converged": result.converged,
        "evaluations": result.evaluations,
        "power": fit.problem.power,
        "priors": [prior.name for prior in fit.problem.priors],
        "warnings": list(result.warnings),
    }
    return Fitted(predict, result.seconds, notes, fit)


def independent_gp(case: Case) -> Fitted:
    """One Gaussian process per joint acceleration."""
    train = evenly(moving(case.train), GP_SAMPLES)
    fit = forcegp.models.IndependentGP(case.system).fit(train)
    noise = fit.training.noise_std.expand_as(train.qdd).square().mean(0).sqrt()

    def predict(data: forcegp.Dataset) -> Predicted:
        found = fit.predict(data.q, data.qd, data.tau)
        assert found.covariance is not None
        known = data.extras.get("qdd_std", noise.expand_as(data.qdd))
        return Predicted(found.mean, found.covariance + torch.diag_embed(known**2), case.system)

    return Fitted(predict, fit.result.seconds, {"samples": GP_SAMPLES})


def network(case: Case) -> Fitted:
    """A network of one hidden layer."""
    train = evenly(moving(case.train), NETWORK_SAMPLES)
    options = BatchOptions(epochs=NETWORK_EPOCHS)
    fit = forcegp.models.NeuralNetwork(case.system).fit(train, options=options)

    def predict(data: forcegp.Dataset) -> Predicted:
        return Predicted(fit.predict(data.q, data.qd, data.tau).mean, None, case.system)

    return Fitted(predict, fit.result.seconds, {"samples": len(train)})


def models(case: Case) -> dict[str, Callable[[], Fitted]]:
    """How each model is fitted, by name."""
    nothing = case.train.qdd.new_zeros(3 * case.train.nq)
    return {
        "mean acceleration": lambda: constant(case),
        "robot file": lambda: rigid(lambda: LeastSquares(case.system, nothing)),
        LEAST_SQUARES[0]: lambda: rigid(lambda: identify_rigid(case.system, case.train)),
        LEAST_SQUARES[1]: lambda: rigid(lambda: identify_rigid(case.system, moving(case.train))),
        "independent GP": lambda: independent_gp(case),
        "network": lambda: network(case),
        "structured GP, defaults": lambda: structured(case),
        f"structured GP, {FEW} samples": lambda: structured(case, FEW),
        "structured GP, friction alone": lambda: structured(case, priors=[JointFrictionPrior()]),
        "structured GP, friction and inertia": lambda: structured(
            case, priors=[JointFrictionPrior(), InertialPrior()]
        ),
    }
