"""Integration of a rollout over time: the methods for one step, and the loop over all steps.

The methods for one step are semi-implicit Euler, fourth-order Runge-Kutta, and the adaptive methods of SciPy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy
import torch
from torch import Tensor

from forcegp.constraints.unilateral import project_state
from forcegp.errors import ForceGPError, ModelError, NumericalError
from forcegp.rollout.events import ContactEvent, advance, settle
from forcegp.rollout.law import REGULARIZATION, STILL, Instant, RolloutProblem, State, Step, compliance_of
from forcegp.rollout.trajectory import Divergence, Rollout

Progress = Callable[[int, int], None]
"""A function called with the number of completed steps and the total number."""

RELATIVE_TOLERANCE = 1e-9
ABSOLUTE_TOLERANCE = 1e-11
"""Tolerances of an adaptive step in position [rad] and velocity [rad/s], well below any model error."""


def semi_implicit_euler(problem: RolloutProblem, state: State, first: Instant, h: Tensor) -> State:
    """Return the state after the first-order step used by simulators, q̇⁺ = q̇ + h q̈, q⁺ = q + h q̇⁺."""
    qd = state.qd + h * first.qdd
    return State(state.t + h, state.q + h * qd, qd, state.active)


def runge_kutta_4(problem: RolloutProblem, state: State, first: Instant, h: Tensor) -> State:
    """Return the state after a step of the classical fourth-order Runge-Kutta method."""
    t, q, qd, active = state
    end, half = t + h, 0.5 * h
    qd2 = qd + half * first.qdd
    a2 = problem.evaluate(State(t + half, q + half * qd, qd2, active), end).qdd
    qd3 = qd + half * a2
    a3 = problem.evaluate(State(t + half, q + half * qd2, qd3, active), end).qdd
    qd4 = qd + h * a3
    a4 = problem.evaluate(State(end, q + h * qd3, qd4, active), end).qdd
    position = q + (h / 6.0) * (qd + 2.0 * (qd2 + qd3) + qd4)
    velocity = qd + (h / 6.0) * (first.qdd + 2.0 * (a2 + a3) + a4)
    return State(end, position, velocity, active)


def adaptive(method: str) -> Step:
    """Return a step function that uses an adaptive method of `scipy.integrate`.

    All rows share the internal steps. Time runs from 0 to 1, since the rows may have different step lengths.
    """

    def step(problem: RolloutProblem, state: State, first: Instant, h: Tensor) -> State:
        if first.qdd.requires_grad:
            raise ModelError(
                f"{method} does not support gradients",
                expected="one of semi_implicit_euler, rk4",
                hint="or call it under torch.no_grad()",
            )
        end, shape = state.t + h, (2, *state.q.shape)

        def rate(s: float, y: np.ndarray) -> np.ndarray:
            q, qd = torch.from_numpy(y.copy()).to(state.q).reshape(shape)
            qdd = problem.evaluate(State(state.t + s * h, q, qd, state.active), end).qdd
            return (h * torch.stack([qd, qdd])).flatten().cpu().double().numpy()

        start = torch.stack([state.q, state.qd]).flatten().cpu().double().numpy()
        with torch.no_grad():
            solved = scipy.integrate.solve_ivp(
                rate, (0.0, 1.0), start, method=method, rtol=RELATIVE_TOLERANCE, atol=ABSOLUTE_TOLERANCE
            )
        if not solved.success:
            raise NumericalError(f"{method} found no sufficiently accurate step", got=solved.message)
        q, qd = torch.from_numpy(solved.y[:, -1].copy()).to(state.q).reshape(shape)
        return State(end, q, qd, state.active)

    return step


METHODS: dict[str, Step] = {
    "semi_implicit_euler": semi_implicit_euler,
    "rk4": runge_kutta_4,
    "rk45": adaptive("RK45"),
    "dop853": adaptive("DOP853"),
}
"""Integration methods, keyed by name."""


@dataclass
class _Record:
    """States and events recorded so far."""

    states: list[State] = field(default_factory=list)
    motions: list[Instant] = field(default_factory=list)
    events: list[ContactEvent] = field(default_factory=list)
    diverged: list[Divergence] = field(default_factory=list)

    def write(self, state: State, now: Instant, alive: Tensor) -> None:
        """Record a state, with NaN in rows that are no longer `alive` `(n,)`."""
        if not bool(alive.all()):
            rows = alive[:, None]
            now = Instant(*(torch.where(rows, x, torch.nan) for x in now[:-1]))  # pyright: ignore[reportArgumentType]
            q, qd = (torch.where(rows, x, torch.nan) for x in (state.q, state.qd))
            state = state._replace(q=q, qd=qd)
        self.states.append(state)
        self.motions.append(now)

    def note(self, events: list[ContactEvent], alive: Tensor) -> None:
        """Record the events of trajectories that are still `alive`."""
        self.events += [event for event in events if bool(alive[event.row])]


def integrate(
    problem: RolloutProblem,
    step: Step,
    start: State,
    dt: float,
    steps: int,
    *,
    project: bool,
    speed_limit: float,
    progress: Progress | None = None,
) -> Rollout:
    """Integrate n trajectories over steps of length dt [s], dropping trajectories that diverge.

    If `project` is true, position and velocity are projected onto the manifold after each step. A trajectory
    counts as diverged if a joint is faster than `speed_limit` [rad/s, m/s]. The result has batch shape
    `(n,)`. It is shorter than requested if all trajectories diverge.
    """
    record, state, step = _Record(), start, _stopping(step)
    alive = torch.ones(len(start.q), dtype=torch.bool, device=start.q.device)
    h = torch.full_like(start.t, dt)
    for k in range(steps + 1):
        # Times are exact multiples of dt: with accumulated rounding errors, inputs would be one sample late.
        state = state._replace(t=torch.full_like(start.t, k * dt))
        try:
            if problem.unilateral:
                state, now, events = settle(problem, state, state.t + h)
                record.note(events, alive)
            else:
                now = problem.evaluate(state, state.t + h)
            record.write(state, now, alive)
            if k == steps:
                break
            length = torch.where(alive[:, None], h, 0.0)
            if problem.unilateral:
                reached, events = advance(problem, step, state, now, length)
                record.note(events, alive)
            else:
                reached = step(problem, state, now, length)
            if project:
                q, qd = project_state(problem.system, reached.q, reached.qd, reached.active & alive[:, None])
                reached = State(reached.t, q, qd, reached.active)
        except NumericalError as error:
            _give_up(record, state, alive, error.message)
            break
        state, alive = _survivors(record, state, reached, alive, speed_limit)
        if not bool(alive.any()):
            break
        if progress is not None:
            progress(k + 1, steps)
    return _result(problem, record, dt)


def _stopping(step: Step) -> Step:
    """Wrap a step function such that contacts and joints stopped by friction are at rest after the step."""

    def stopped(problem: RolloutProblem, state: State, first: Instant, h: Tensor) -> State:
        reached = problem.stopped(state, step(problem, state, first, h))
        if first.held is None:
            return reached
        slowed = (reached.qd.abs() <= 0.5 * state.qd.abs()) | (state.qd == 0.0)
        held = first.held & slowed & (h > 0.0)
        if bool((held & (reached.qd.abs() > STILL)).any()):
            reached = _braked(problem, reached, held)
        return reached._replace(qd=torch.where(held, 0.0, reached.qd))

    return stopped


def _braked(problem: RolloutProblem, state: State, held: Tensor) -> State:
    """Return the state after the friction impulse that stops the joints in `held`.

    The impulse also changes the speed of other joints. Stopping a joint alone could add kinetic energy.
    """
    G = problem.system.equations(state.q, state.qd, state.active).H
    eye = torch.eye(G.shape[-1], dtype=G.dtype, device=G.device)
    sticks = torch.where(held[..., None], G + torch.diag_embed(REGULARIZATION * compliance_of(G)), eye)
    impulse = torch.linalg.solve(sticks, torch.where(held, -state.qd, 0.0)[..., None])
    return state._replace(qd=state.qd + (G @ impulse)[..., 0])


def _survivors(
    record: _Record, before: State, after: State, alive: Tensor, speed_limit: float
) -> tuple[State, Tensor]:
    """Return the state after a step, with diverged trajectories held at their previous state."""
    sound = torch.isfinite(after.q).all(-1) & (after.qd.abs().amax(-1) < speed_limit)
    if bool(sound.all()):
        return after, alive
    reason = f"a joint speed of {speed_limit:g} or more, or a state not finite"
    _give_up(record, before, alive & ~sound, reason)
    return after.where(sound, before), alive & sound


def _give_up(record: _Record, state: State, rows: Tensor, reason: str) -> None:
    for row in rows.nonzero()[:, 0].tolist():
        t, q, qd = float(state.t[row, 0]), state.q[row].tolist(), state.qd[row].tolist()
        record.diverged.append(Divergence(t, row, q, qd, reason))


def _result(problem: RolloutProblem, record: _Record, dt: float) -> Rollout:
    states, motions = record.states, record.motions
    if not motions:
        raise ForceGPError(
            "the motion at the initial state cannot be computed",
            got=record.diverged[0].reason,
            hint="start elsewhere, or use RolloutOptions(sticking=False)",
        )

    def over_time(values: Sequence[State] | Sequence[Instant], names: str) -> dict[str, Tensor]:
        return {name: torch.stack([getattr(x, name) for x in values], dim=1) for name in names.split()}

    t = torch.arange(len(states), dtype=states[0].t.dtype, device=states[0].t.device) * dt
    columns = over_time(states, "q qd active") | over_time(motions, "qdd tau multiplier c cd")
    events, diverged = tuple(record.events), tuple(record.diverged)
    return Rollout(problem.system, t, **columns, samples=None, events=events, diverged=diverged)
