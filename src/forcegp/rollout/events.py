"""Times at which contacts open and close, located within a step.

A closed contact opens when λ falls to zero, and an open contact closes when c falls to zero, as described in
`constraints/unilateral.py`. The probability that a contact opens at a state is computed from the posterior
over the multiplier.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.constraints.unilateral import normal_rows, project_velocity, pulling, reached, rows_of
from forcegp.errors import ModelError
from forcegp.rollout.inputs import ForwardModel
from forcegp.rollout.law import Instant, RolloutProblem, State, Step

MAX_EVENTS = 8
"""Maximum number of events within a step. A contact that bounces to rest would have infinitely many."""
LOCATION = 1e-9
"""An event is located when λ or c, relative to its value at the start of the step, falls below this value."""
MAX_TRIALS = 40
"""Maximum number of trials to locate an event. The Illinois variant of regula falsi needs about eight."""


class ContactEvent(NamedTuple):
    """A contact that opened or closed.

    Attributes:
        t: time [s].
        row: index of the trajectory in the flattened batch.
        contact: name of the contact.
        closed: whether the contact is closed afterwards.
    """

    t: float
    row: int
    contact: str
    closed: bool


def _signal(problem: RolloutProblem, state: State, now: Instant) -> tuple[Tensor, Tensor]:
    """Return the signals `(n, n_contacts)` that cross zero at the next event, and whether they have."""
    system, active = problem.system, state.active
    crossed = pulling(system, active, now.multiplier) | reached(system, active, now.c, now.cd)
    signal = torch.where(rows_of(system, active), now.multiplier, now.c)
    return normal_rows(system, signal), crossed


def switch(problem: RolloutProblem, state: State, crossed: Tensor) -> State:
    """Open or close the contacts whose signals have crossed zero, with an impact when a contact closes."""
    active = state.active ^ crossed
    landing = (crossed & active).any(-1)
    if not bool(landing.any()):
        return state._replace(active=active)
    after = project_velocity(problem.system.equations(state.q, state.qd, active), state.qd)
    return state._replace(qd=torch.where(landing[:, None], after, state.qd), active=active)


def settle(problem: RolloutProblem, state: State, end: Tensor) -> tuple[State, Instant, list[ContactEvent]]:
    """Open contacts that pull, close contacts that touch, and return the state at the start of a step.

    The torque, and therefore λ, may jump at the start of a step.
    """
    now = problem.evaluate(state, end)
    events: list[ContactEvent] = []
    for _ in range(MAX_EVENTS):
        _, crossed = _signal(problem, state, now)
        if not bool(crossed.any()):
            break
        state = switch(problem, state, crossed)
        events += _listed(problem, state, crossed)
        now = problem.evaluate(state, end)
    return state, now, events


def advance(
    problem: RolloutProblem, step: Step, state: State, first: Instant, h: Tensor
) -> tuple[State, list[ContactEvent]]:
    """Advance the batch by one step of length h `(n, 1)` [s], stopping each trajectory at its events."""
    trial = step(problem, state, first, h)
    events: list[ContactEvent] = []
    for _ in range(MAX_EVENTS):
        signal, crossed = _signal(problem, trial, problem.evaluate(trial, trial.t))
        rows = crossed.any(-1)
        if not bool(rows.any()):
            break
        fraction = _locate(problem, step, state, first, h, signal, crossed)
        reached = step(problem, state, first, fraction * h)
        signal, _ = _signal(problem, reached, problem.evaluate(reached, trial.t))
        nearest = torch.where(crossed, signal, torch.inf)
        now = crossed & (nearest <= nearest.amin(-1, keepdim=True).clamp(min=0.0))
        switched = switch(problem, reached, now)
        events += _listed(problem, switched, now)
        h = torch.where(rows[:, None], (1.0 - fraction) * h, 0.0)
        state = switched.where(rows, trial)
        first = problem.evaluate(state, state.t + h)
        trial = step(problem, state, first, h)
    return trial, events


@torch.no_grad()
def _locate(
    problem: RolloutProblem,
    step: Step,
    state: State,
    first: Instant,
    h: Tensor,
    signal: Tensor,
    crossed: Tensor,
) -> Tensor:
    """Return the fraction `(n, 1)` of the step at which the first signal crosses zero, or 1 if none does."""

    def smallest(values: Tensor) -> Tensor:
        return torch.where(crossed, values, torch.inf).amin(-1, keepdim=True)

    rows = crossed.any(-1, keepdim=True)
    start = smallest(_signal(problem, state, first)[0])
    low, high = torch.zeros_like(h), torch.ones_like(h)
    g_low, g_high = start.clamp(min=0.0), smallest(signal)
    moved = torch.zeros_like(low)
    fraction = high
    for _ in range(MAX_TRIALS):
        fraction = torch.where(rows, low + (high - low) * g_low / (g_low - g_high), 1.0)
        at = step(problem, state, first, fraction * h)
        g = smallest(_signal(problem, at, problem.evaluate(at, state.t + h))[0])
        done = ~rows | (g.abs() <= LOCATION * g_low.clamp(min=1e-3)) | (start <= 0.0)
        if bool(done.all()):
            break
        below = g < 0.0
        # Illinois: halve the value at an end that is retained twice in a row, or it would stay forever.
        g_low = torch.where(below, torch.where(moved == 1.0, 0.5 * g_low, g_low), g)
        g_high = torch.where(below, g, torch.where(moved == -1.0, 0.5 * g_high, g_high))
        low, high = torch.where(below, low, fraction), torch.where(below, fraction, high)
        moved = torch.where(below, 1.0, -1.0)
    return fraction


def _listed(problem: RolloutProblem, state: State, crossed: Tensor) -> list[ContactEvent]:
    names = problem.system.contact_names
    return [
        ContactEvent(float(state.t[row, 0]), row, names[k], bool(state.active[row, k]))
        for row, k in crossed.nonzero().tolist()
    ]


def contact_loss_probability(
    model: ForwardModel, q: Tensor, qd: Tensor, tau: Tensor, *, active: Tensor | None = None
) -> Tensor:
    """Return the probability `(*batch, n_contacts)` that each contact opens at states `(*batch, nq)`.

    P(λ < 0) = Φ(−μ/σ) for the posterior N(μ, σ²) of its normal multiplier, 1 for an open contact. `active` is
    a mask `(*batch, n_contacts)` of closed contacts. By default, all contacts are closed.

    Raises:
        ModelError: the model does not predict the variance of the multiplier.
    """
    prediction = model.predict(q, qd, tau, "multiplier", active=active, covariance=True)
    if prediction.std is None:
        raise ModelError(
            f"a {model.kind!r} model does not predict the uncertainty of the multiplier",
            hint="use StructuredGP, or compare the predicted multiplier with zero",
        )
    closed = model.system.active_rows(active, prediction.mean.shape[:-1])
    mean, std, closed = (normal_rows(model.system, x) for x in (prediction.mean, prediction.std, closed))
    certain = std == 0.0
    probability = torch.special.ndtr(-mean / torch.where(certain, 1.0, std))
    probability = torch.where(certain, (mean < 0.0).to(probability.dtype), probability)
    return torch.where(closed, probability, 1.0)
