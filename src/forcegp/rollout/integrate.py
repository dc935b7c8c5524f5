"""One step of a rollout: semi-implicit Euler, Runge-Kutta of order four, or adaptive with error control."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from forcegp.errors import ModelError, NumericalError, UnknownNameError
from forcegp.rollout.problem import Evaluation, Problem, State

Step = Callable[[Problem, State, Evaluation, Tensor], State]
"""Advance a state, whose motion is known, by steps h `(n, 1)` [s]."""

RELATIVE_TOLERANCE = 1e-9
ABSOLUTE_TOLERANCE = 1e-11
"""Error of an adaptive step in position [rad] and velocity [rad/s]: well below any model's own error."""


def semi_implicit_euler(problem: Problem, state: State, first: Evaluation, h: Tensor) -> State:
    """q̇⁺ = q̇ + h q̈, q⁺ = q + h q̇⁺, the step of the simulators; of first order."""
    qd = state.qd + h * first.qdd
    return State(state.t + h, state.q + h * qd, qd, state.active)


def runge_kutta_4(problem: Problem, state: State, first: Evaluation, h: Tensor) -> State:
    """The classical Runge-Kutta method, of fourth order."""
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
    """A step made of as many steps of a method of `scipy.integrate` as its error control asks for.

    The whole batch shares the steps. Time runs from 0 to 1 within the step, so that trajectories whose
    steps differ, as after an event, are solved together.
    """

    def step(problem: Problem, state: State, first: Evaluation, h: Tensor) -> State:
        _refuse_gradients(first, method)
        end, shape = state.t + h, (2, *state.q.shape)

        def rate(s: float, y: np.ndarray) -> np.ndarray:
            q, qd = torch.from_numpy(y.copy()).to(state.q).reshape(shape)
            qdd = problem.evaluate(State(state.t + s * h, q, qd, state.active), end).qdd
            return (h * torch.stack([qd, qdd])).flatten().cpu().double().numpy()

        start = torch.stack([state.q, state.qd]).flatten().cpu().double().numpy()
        with torch.no_grad():
            solved = solve_ivp(
                rate, (0.0, 1.0), start, method=method, rtol=RELATIVE_TOLERANCE, atol=ABSOLUTE_TOLERANCE
            )
        if not solved.success:
            raise NumericalError(f"{method} finds no step that is accurate enough", got=solved.message)
        q, qd = torch.from_numpy(solved.y[:, -1].copy()).to(state.q).reshape(shape)
        return State(end, q, qd, state.active)

    return step


def _refuse_gradients(first: Evaluation, method: str) -> None:
    if first.qdd.requires_grad:
        raise ModelError(
            f"{method} has no gradients",
            expected="one of semi_implicit_euler, rk4",
            hint="or call it under torch.no_grad()",
        )


METHODS: dict[str, Step] = {
    "semi_implicit_euler": semi_implicit_euler,
    "rk4": runge_kutta_4,
    "rk45": adaptive("RK45"),
    "dop853": adaptive("DOP853"),
}
"""The methods of integration, by name."""


def step_of(method: str) -> Step:
    """A method by name.

    Raises:
        UnknownNameError: no such method.
    """
    if method not in METHODS:
        raise UnknownNameError("method of integration", method, METHODS)
    return METHODS[method]
