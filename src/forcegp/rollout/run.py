"""Roll a law of motion forward in time from a batch of initial states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.errors import ForceGPError, NumericalError
from forcegp.rollout.contact import ContactEvent, advance, settle
from forcegp.rollout.integrate import Step
from forcegp.rollout.problem import Evaluation, Problem, State
from forcegp.rollout.stabilize import projected
from forcegp.rollout.trajectory import Divergence, Rollout

Progress = Callable[[int, int], None]
"""Called with the number of steps done and the number in all."""


@dataclass
class _Record:
    """States at output times, as they are reached."""

    states: list[State] = field(default_factory=list)
    motions: list[Evaluation] = field(default_factory=list)
    events: list[ContactEvent] = field(default_factory=list)
    diverged: list[Divergence] = field(default_factory=list)

    def write(self, state: State, now: Evaluation, alive: Tensor) -> None:
        """Keep a state; NaN in the rows `(n,)` that are given up."""
        if not bool(alive.all()):
            rows = alive[:, None]
            now = Evaluation(*(torch.where(rows, x, torch.nan) for x in now))
            state = state._replace(
                q=torch.where(rows, state.q, torch.nan), qd=torch.where(rows, state.qd, torch.nan)
            )
        self.states.append(state)
        self.motions.append(now)


def run(
    problem: Problem,
    step: Step,
    start: State,
    dt: float,
    steps: int,
    *,
    project: bool,
    speed_limit: float,
    progress: Progress | None = None,
) -> Rollout:
    """Integrate n trajectories; one that diverges is given up while the others go on.

    Args:
        problem: what is integrated.
        step: method of integration.
        start: initial states.
        dt: step, and period of the output [s].
        steps: how many.
        project: whether to project position and velocity onto the manifold after each step.
        speed_limit: a joint faster than this counts as diverged [rad/s, m/s].
        progress: called after each step.

    Returns:
        The trajectories, batch `(n,)`; shorter than asked for where all diverged.
    """
    record, state = _Record(), start
    alive = torch.ones(len(start.q), dtype=torch.bool, device=start.q.device)
    h = torch.full_like(start.t, dt)
    for k in range(steps + 1):
        # Times are multiples of dt, lest rounding add up and inputs be read one sample late.
        state = state._replace(t=torch.full_like(start.t, k * dt))
        try:
            state, now, events = settle(problem, state, state.t + h)
            record.write(state, now, alive)
            record.events += [event for event in events if bool(alive[event.row])]
            if k == steps:
                break
            reached, events = advance(problem, step, state, now, torch.where(alive[:, None], h, 0.0))
            if project:
                reached = projected(problem.system, reached, alive)
        except NumericalError as error:
            _give_up(record, state, alive, error.message)
            break
        record.events += [event for event in events if bool(alive[event.row])]
        state, alive = _survivors(record, state, reached, alive, speed_limit)
        if not bool(alive.any()):
            break
        if progress is not None:
            progress(k + 1, steps)
    return _result(problem, record, dt)


def _survivors(
    record: _Record, before: State, after: State, alive: Tensor, speed_limit: float
) -> tuple[State, Tensor]:
    """The state after a step, with trajectories that diverged held where they were."""
    sound = torch.isfinite(after.q).all(-1) & (after.qd.abs().amax(-1) < speed_limit)
    if bool(sound.all()):
        return after, alive
    _give_up(
        record, before, alive & ~sound, f"a joint speed of {speed_limit:g} or more, or a state not finite"
    )
    return after.where(sound, before), alive & sound


def _give_up(record: _Record, state: State, rows: Tensor, reason: str) -> None:
    for row in rows.nonzero()[:, 0].tolist():
        t, q, qd = float(state.t[row, 0]), state.q[row].tolist(), state.qd[row].tolist()
        record.diverged.append(Divergence(t, row, q, qd, reason))


def _result(problem: Problem, record: _Record, dt: float) -> Rollout:
    states, motions = record.states, record.motions
    if not motions:
        raise ForceGPError(
            "the motion at the initial state cannot be computed", got=record.diverged[0].reason
        )

    def over_time(values: list[Tensor]) -> Tensor:
        return torch.stack(values, dim=1)

    t = torch.arange(len(states), dtype=states[0].t.dtype, device=states[0].t.device) * dt
    return Rollout(
        system=problem.system,
        t=t,
        q=over_time([state.q for state in states]),
        qd=over_time([state.qd for state in states]),
        qdd=over_time([motion.qdd for motion in motions]),
        tau=over_time([motion.tau for motion in motions]),
        multiplier=over_time([motion.multiplier for motion in motions]),
        c=over_time([motion.c for motion in motions]),
        cd=over_time([motion.cd for motion in motions]),
        active=over_time([state.active for state in states]),
        events=tuple(record.events),
        diverged=tuple(record.diverged),
    )
