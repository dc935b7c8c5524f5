"""Long-term predictions: roll a model, or any force law, forward from initial states (section 4)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import Baumgarte, ConstrainedSystem
from forcegp.errors import ForceGPError
from forcegp.models.base import Model
from forcegp.rollout.contact import check_unilateral
from forcegp.rollout.inputs import Inputs, inputs_of
from forcegp.rollout.integrate import step_of
from forcegp.rollout.law import ForceLaw, Law, law_of
from forcegp.rollout.problem import Problem, State
from forcegp.rollout.run import Progress, run
from forcegp.rollout.stabilize import stabilized_system
from forcegp.rollout.trajectory import DivergedError, Rollout
from forcegp.threads import one_thread

CLOSED = 5e-4
"""Where contacts can open, one is closed at the start if its error is below this [m]: more than the drift of
a logged contact, less than a distance that anybody would call off the surface."""

FEW = 8
"""So many trajectories at most are computed on one thread, as more only slow down work on small tensors."""

Torque = Tensor | Inputs | Callable[[Tensor, Tensor, Tensor], Tensor]
"""An array over time `(samples, nq)` or `(*batch, samples, nq)`, or a law of (t, q, q̇)."""


@dataclass(frozen=True)
class RolloutOptions:
    """How a rollout is computed.

    Args:
        dt: step, period of the output, and sampling period of torques given as an array [s].
        method: `semi_implicit_euler` (the simulators' step), `rk4`, or, adaptive within each step,
            `rk45` and `dop853` of SciPy.
        stabilization: `none`, `baumgarte` (the system's own terms, or the default ones), other
            `Baumgarte` terms, or `projection` of q and q̇ after each step.
        unilateral: whether contacts with a surface open where they would pull, and close again.
        interpolation: `hold` each torque of an array for its period, or go to the next one `linear`ly.
        speed_limit: a joint faster than this counts as diverged [rad/s, m/s].
        on_divergence: `raise` a `DivergedError` that holds the trajectories, or `keep` them.

    Raises:
        ForceGPError: a value is out of range.
    """

    dt: float = 1.0 / 240.0
    method: str = "semi_implicit_euler"
    stabilization: str | Baumgarte = "baumgarte"
    unilateral: bool = False
    interpolation: str = "hold"
    speed_limit: float = 100.0
    on_divergence: str = "raise"

    def __post_init__(self) -> None:
        for name in ("dt", "speed_limit"):
            value = getattr(self, name)
            if not 0.0 < value < float("inf"):
                raise ForceGPError(
                    f"the rollout's {name} is out of range", expected="a positive finite number", got=value
                )
        if self.on_divergence not in ("raise", "keep"):
            raise ForceGPError(
                "no such way to treat a divergence", expected="'raise' or 'keep'", got=self.on_divergence
            )
        step_of(self.method)


def rollout(
    law: Law,
    system: ConstrainedSystem,
    q0: Tensor,
    qd0: Tensor,
    tau: Torque,
    duration: float = 10.0,
    *,
    active: Tensor | None = None,
    options: RolloutOptions | None = None,
    progress: Progress | None = None,
) -> Rollout:
    """Integrate q̈ = law(q, q̇, τ) from initial states.

    With the fixed-step methods the result is differentiable with respect to the initial state, the
    torques and the figures of the robot, as long as no contact opens or closes.

    Args:
        law: what gives the acceleration.
        system: robot and contacts.
        q0, qd0: `(*batch, nq)` initial states.
        tau: motor torque Q_u over time, or a feedback law.
        duration: simulated time [s], rounded to whole steps.
        active: `(*batch, n_contacts)` bool, contacts closed at the start; by default all, or, where
            contacts can open, those that touch.
        options: step, method, stabilization.
        progress: called as the run goes on.

    Raises:
        DivergedError: a trajectory diverged; the error holds what was computed.
        ShapeError: an argument does not fit the robot.
        ModelError: contacts can open but the law has no multiplier.
    """
    options = options or RolloutOptions()
    batch = torch.broadcast_shapes(q0.shape[:-1], qd0.shape[:-1])
    found = _run(law, system, q0, qd0, tau, duration, batch, active, options, progress)
    return _checked(found, options)


def rollout_model(
    model: Model,
    q0: Tensor,
    qd0: Tensor,
    tau: Torque,
    duration: float = 10.0,
    samples: int = 0,
    *,
    seed: int = 0,
    active: Tensor | None = None,
    system: ConstrainedSystem | None = None,
    options: RolloutOptions | None = None,
    progress: Progress | None = None,
) -> Rollout:
    """The mean motion of a model, and those of functions drawn from its posterior.

    Each sample is one deterministic force function, so each of its trajectories obeys the constraint and
    Newton's equation.

    Args:
        model: a fitted model.
        q0, qd0, tau, duration, active, options, progress: see `rollout`.
        samples: number S of function samples; all are integrated together.
        seed: of the samples.
        system: roll out on another system, such as another surface, or a robot with other figures.

    Returns:
        The mean motion, with the trajectories of the samples, batch `(S, *batch)`, as `samples`.

    Raises:
        DivergedError: a trajectory diverged; the error holds what was computed.
        ModelError: the model is not fitted, or has no function samples.
    """
    options, system = options or RolloutOptions(), system or model.system
    batch = torch.broadcast_shapes(q0.shape[:-1], qd0.shape[:-1])
    shares = 2 if samples else 1
    found = _run(
        law_of(model), system, q0, qd0, tau, duration, batch, active, options, _share(progress, 0, shares)
    )
    if samples:
        force = model.force_samples(samples, torch.Generator().manual_seed(seed))
        whole = torch.Size((samples, *batch))
        report = _share(progress, 1, shares)
        sampled = _run(
            ForceLaw(force), system, q0, qd0, tau, duration, whole, active, options, report, batch=batch
        )
        found = dataclasses.replace(found, samples=sampled)
    return _checked(found, options)


def _run(
    law: Law,
    system: ConstrainedSystem,
    q0: Tensor,
    qd0: Tensor,
    tau: Torque,
    duration: float,
    whole: torch.Size,
    active: Tensor | None,
    options: RolloutOptions,
    progress: Progress | None,
    *,
    batch: torch.Size | None = None,
) -> Rollout:
    system.robot.check_state(q0=q0, qd0=qd0)
    stable, project = stabilized_system(system, options.stabilization)
    n = whole.numel()
    inputs = inputs_of(tau, whole if batch is None else batch, n, options.dt, options.interpolation)
    problem = Problem(stable, law, inputs, options.unilateral and len(system.contacts) > 0)
    check_unilateral(problem)
    q, qd = (x.expand(*whole, x.shape[-1]).reshape(n, -1) for x in (q0, qd0))
    closed = _closed(problem, q, qd) if active is None else active.expand(*whole, -1).reshape(n, -1)
    start = State(q.new_zeros(n, 1), q, qd, closed)
    steps = max(1, round(duration / options.dt))
    with one_thread() if n <= FEW else nullcontext():
        found = run(
            problem,
            step_of(options.method),
            start,
            options.dt,
            steps,
            project=project,
            speed_limit=options.speed_limit,
            progress=progress,
        )
    names = ("q", "qd", "qdd", "tau", "multiplier", "c", "cd", "active")
    return dataclasses.replace(
        found,
        **{
            name: getattr(found, name).unflatten(0, whole) if whole else getattr(found, name)[0]
            for name in names
        },
    )


def _closed(problem: Problem, q: Tensor, qd: Tensor) -> Tensor:
    """Contacts closed at the start `(n, n_contacts)`."""
    closed = torch.ones(len(q), len(problem.system.contacts), dtype=torch.bool, device=q.device)
    if not problem.unilateral:
        return closed
    with torch.no_grad():
        apart = problem.by_contact(problem.system.equations(q, qd).c.abs() > CLOSED)
    return closed & ~(apart & problem.can_open)


def _share(progress: Progress | None, part: int, parts: int) -> Progress | None:
    """Progress of one of several runs of the same length, as part of the whole."""
    if progress is None:
        return None
    return lambda done, total: progress(part * total + done, parts * total)


def _checked(found: Rollout, options: RolloutOptions) -> Rollout:
    for member in (found, found.samples):
        if options.on_divergence == "raise" and member is not None and member.diverged:
            raise DivergedError(member.diverged, member.rows, found)
    return found
