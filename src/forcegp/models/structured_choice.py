"""Which default priors a measured robot gets: those that predict unseen stretches of its training log best.

Friction of joints and contacts is always unknown. Whether the inertial parameters of the robot file are to be
doubted is decided by the training log: each stretch of it is predicted from the others, with and without an
`InertialPrior`. What counts is the error of accelerations. By the error of torques a robot without inertia
would win wherever torques are small.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from forcegp.data import Dataset
from forcegp.forces.calibration import FEWEST, stretches
from forcegp.forces.inference import force_posterior
from forcegp.forces.learn import Problem
from forcegp.forces.measurements import Measurement, Observation
from forcegp.forces.priors.default import measured_priors
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.quantities import affine_map, states
from forcegp.models.structured_fit import StructuredFit
from forcegp.models.structured_learning import LEARN_SAMPLES, REST_SPEED, with_updated_robot
from forcegp.models.structured_spec import Specification

Data = Dataset | Sequence[Observation]


def chosen_priors(
    spec: Specification, data: Data, fit: Callable[[Specification, Data], StructuredFit]
) -> Specification:
    """The specification with the default priors that suit a measured log.

    Args:
        spec: with `measured_priors`.
        data: the training log; at most `LEARN_SAMPLES` evenly spaced samples of it are used.
        fit: fits a specification to data.
    """
    friction = measured_priors(spec.system)
    candidates = [dataclasses.replace(spec, priors=p) for p in (friction, (*friction, InertialPrior()))]
    few = _few(data)
    errors = [held_out_error(candidate, fit(candidate, few)) for candidate in candidates]
    return candidates[errors.index(min(errors))]


@torch.no_grad()
def held_out_error(spec: Specification, fit: StructuredFit) -> float:
    """Mean over the joints of the log of the root-mean-square error of predicted accelerations.

    Args:
        spec: of the fit, with the robot as it was before; each stretch of the training log is predicted by
            the posterior of all others, with the robot that they ask for.
        fit: its hyperparameters are kept.

    Returns:
        The error, of which only differences mean something; 0 where there are too few samples to tell.
    """
    training, values = fit.training, fit.hyperparameters
    whole = dataclasses.replace(spec.problem(training), power=fit.problem.power)
    errors = []
    for i in (i for i, quantity in enumerate(training.quantities) if quantity == "qdd"):
        m = training.measurements[i]
        group = stretches(m.segment)
        for g in group.unique().tolist():
            own = (group == g).nonzero()[:, 0]
            rest = dataclasses.replace(whole, training=training.without(i, own))
            errors.append(_error(with_updated_robot(rest, values), values, m[own]))
    if sum(map(len, errors)) < FEWEST:
        return 0.0
    return float(0.5 * torch.cat(errors).square().mean(0).log().mean())


def _error(problem: Problem, values: Mapping[str, Tensor], m: Measurement) -> Tensor:
    """Predicted minus measured accelerations of unseen samples, `(n, nq)`."""
    posterior, system = force_posterior(problem, values), problem.system
    at = states(system, *m.states)
    return posterior.read_mean(system, at, affine_map(system, at, "qdd")) - m.values


def _few(data: Data) -> Data:
    """Evenly spaced samples in motion."""
    if not isinstance(data, Dataset):
        return [dataclasses.replace(o, data=_few(o.data)) for o in data]
    moving = (data.qd.abs().amax(-1) > REST_SPEED).nonzero()[:, 0]
    if len(moving) < FEWEST:
        return data
    step = max(1, -(-len(moving) // LEARN_SAMPLES))
    return data[moving[::step]]
