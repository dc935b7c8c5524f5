"""Noise of the state propagated through the learned forces, alternating slopes and hyperparameters.

The first fit propagates the noise of the state through the equations of motion of the robot file
(`noise.py`), which lack the unknown forces: a spring of 100 N m/rad turns noise of 1 mrad into 0.1 N m.
Following McHutchon and Rasmussen (*Gaussian process training with input noise*, 2011), take the slope of the
posterior mean F̄ at each sample and learn again with

    cov(y_i) = Σ_y + G_i Σ_x G_iᵀ,   G_i = ∂(L b + H F̄)/∂(q, q̇) + H ∂F̄/∂(q, q̇),

where the first derivative is at fixed F̄; likewise for multipliers. The posterior mean can be worse than the
robot file, for example far from other samples, so the slopes are kept only if the evidence of the training
data, with the weak priors, increases.
"""

from __future__ import annotations

import dataclasses

from forcegp.errors import NumericalError
from forcegp.forces.inference import force_posterior
from forcegp.forces.learn import Problem
from forcegp.forces.noise import learned_slopes
from forcegp.forces.start import Search
from forcegp.gp.optimise import Learned, Progress

ROUNDS = 3
"""Most rounds of slopes and hyperparameters."""
GROWTH = 1.0
"""Increase of the log evidence below which the rounds end."""


def with_learned_slopes(
    problem: Problem, search: Search, learned: Learned, progress: Progress | None = None
) -> tuple[Problem, Learned, tuple[str, ...]]:
    """The problem with the slopes of its learned forces, and what is learned with them.

    Nothing changes if a force is a function of time, or if the slopes cannot be computed or learned with, as
    those of a force that is not made of tensors; a warning says so.

    Args:
        problem: exact, with noise of the state and the slopes of the robot file.
        search: what is learned and what is held.
        learned: what was learned of the problem.
        progress: called after each evaluation.

    Returns:
        The problem, what is learned, and warnings.
    """
    if any(prior.in_time for prior in problem.priors):
        return problem, learned, ()
    for _ in range(ROUNDS):
        values = {**search.held, **learned.tensors}
        posterior, system = force_posterior(problem, values), problem.system_at(values)
        try:
            training = learned_slopes(problem.training, system, posterior)
            updated = dataclasses.replace(problem, training=training)
            relearned = search.solve(updated, progress, learned.tensors)
        except (NumericalError, RuntimeError) as cause:
            text = "the slopes of the learned forces, which noise of the state asks for, cannot be used"
            return problem, learned, (f"{text}: {str(cause).splitlines()[0]}",)
        growth = learned.value - relearned.value
        if growth > 0.0:
            problem, learned = updated, relearned
        if not growth >= GROWTH:
            break
    return problem, learned, ()


def without_slopes(problem: Problem) -> Problem:
    """The problem with the slopes of the robot file."""
    if problem.training.slopes is None:
        return problem
    return dataclasses.replace(problem, training=dataclasses.replace(problem.training, slopes=None))
