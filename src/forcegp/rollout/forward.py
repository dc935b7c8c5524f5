"""Long-term predictions by integrating a model, or any other acceleration law (section 4)."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import Baumgarte, ConstrainedSystem
from forcegp.constraints.compiled_system import compiled_system
from forcegp.constraints.unilateral import any_row
from forcegp.data import Dataset
from forcegp.errors import ForceGPError, ModelError, check_name
from forcegp.resources import one_thread
from forcegp.rollout.inputs import STEP, Disturbance, Disturbed, ForwardModel, Torque, inputs_of
from forcegp.rollout.integrate import METHODS, Progress, integrate
from forcegp.rollout.law import ForceLaw, Law, RolloutProblem, State, law_of
from forcegp.rollout.trajectory import FIELDS, DivergedError, Rollout

CLOSED = 5e-4
"""A contact that can open is initially closed if its constraint error is below this value [m]. The value is
larger than the drift of a logged contact, but smaller than the distance of a tip that is off the surface.
"""
STEPS_PER_STATE = 4
"""Number of recorded steps that need as much memory as the equations of motion at one state, as measured."""
FEW = 8
"""Number of trajectories up to which one thread is used. More threads are slower on small tensors."""
COMPILED_STEPS = 1000
"""Number of steps above which compiled mechanics save more time than their compilation takes."""


@dataclass(frozen=True)
class RolloutOptions:
    """Options for a rollout.

    Args:
        dt: step size, output period, and sampling period of torques passed as an array [s]. The default is
            the period of a log or controller, and 1/240 s for a feedback law. An array requires `dt`.
        method: `semi_implicit_euler` (the method of the simulators), `rk4`, or SciPy's adaptive `rk45` and
            `dop853`, which choose their steps within each output period.
        stabilization: `none`, `baumgarte` (the terms of the system, or default terms), custom `Baumgarte`
            terms, or `projection`, which projects q and q̇ onto the manifold after each step.
        unilateral: whether contacts with a surface open when they would pull, and may close again.
        interpolation: interpolation of a torque array between samples, `hold` or `linear`.
        speed_limit: joint speed above which a trajectory counts as diverged [rad/s, m/s].
        torque_noise: whether each function sample has independent torque noise and independent unknown
            forces. The noise requires a model that has learned the noise of logged torques. The unknown
            forces are constant over a trajectory, and are used if their size is given.
        sticking: whether dry joint friction, from the robot file or from a prior such as
            `JointFrictionPrior`, holds a joint at rest while the net force is within the friction limit.
            Otherwise, friction is a smooth function of the velocity, and joints creep.
        on_divergence: `raise` raises a `DivergedError` that contains the trajectories, and `keep` keeps them.

    Example:
        >>> RolloutOptions(method="rk4", stabilization="projection", dt=0.002).method
        'rk4'

    Raises:
        ForceGPError: a value is out of range.
        UnknownNameError: the method, stabilization or `on_divergence` is unknown.
    """

    dt: float | None = None
    method: str = "semi_implicit_euler"
    stabilization: str | Baumgarte = "baumgarte"
    unilateral: bool = False
    interpolation: str = "hold"
    speed_limit: float = 100.0
    torque_noise: bool = True
    sticking: bool = True
    on_divergence: str = "raise"

    def __post_init__(self) -> None:
        for name in ("dt", "speed_limit"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < float("inf"):
                raise ForceGPError(
                    f"the rollout's {name} is out of range", expected="a positive finite number", got=value
                )
        check_name("method of integration", self.method, METHODS)
        check_name("on_divergence", self.on_divergence, ("raise", "keep"))
        if not isinstance(self.stabilization, Baumgarte):
            check_name("stabilization", self.stabilization, ("none", "baumgarte", "projection"))

    def stabilized(self, system: ConstrainedSystem) -> ConstrainedSystem:
        """Return the system with the stabilization terms of the rollout on the right-hand side."""
        terms = self.stabilization if isinstance(self.stabilization, Baumgarte) else None
        if self.stabilization == "baumgarte":
            terms = system.baumgarte or Baumgarte()
        return system if terms == system.baumgarte else dataclasses.replace(system, baumgarte=terms)


DEFAULT = RolloutOptions()


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

    With fixed-step methods, the result is differentiable with respect to the initial state, the torques and
    the parameters of the robot, provided that no contact opens or closes.

    Args:
        law: the law that gives the acceleration.
        system: the robot and its contacts.
        q0, qd0: initial states, `(*batch, nq)`.
        tau: motor torque Q_u. It is a log, an array over time with its sampling period in `options`, or a
            function of (t, q, q̇).
        duration: simulated time [s], rounded to whole steps.
        active: mask `(*batch, n_contacts)` of initially closed contacts. By default, all contacts are closed
            or, if contacts can open, those that touch their surface.
        options: options such as step size, method and stabilization.
        progress: a function called after each step.

    Raises:
        DivergedError: a trajectory diverged. The error contains the result.
        ShapeError: an argument does not match the robot.
        ModelError: contacts can open but the law has no multiplier, or the torques have no sampling period.
    """
    options = options or DEFAULT
    batch = torch.broadcast_shapes(q0.shape[:-1], qd0.shape[:-1])
    return _checked(_run(law, system, (q0, qd0), tau, duration, batch, active, options, progress), options)


def rollout_model(
    model: ForwardModel,
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
    """Return the mean motion of a model, and its motions under functions drawn from the posterior.

    Each sample is a deterministic force function, so its trajectories satisfy the constraint and Newton's
    equations. If the model has learned the torque noise, independent noise is added to each sample (see
    `RolloutOptions.torque_noise`).

    Args:
        model: a fitted model.
        q0, qd0, tau, duration, active, options, progress: see `rollout`.
        samples: number S of function samples, which are integrated together.
        seed: random seed for the samples.
        system: a different system, for example with a different surface or different robot parameters.

    Returns:
        The mean motion. Its `samples` are the sampled trajectories, with batch shape `(S, *batch)`.

    Raises:
        DivergedError: a trajectory diverged. The error contains the result.
        ModelError: the model does not support function samples, or does not support other systems.
    """
    options = options or DEFAULT
    batch = torch.broadcast_shapes(q0.shape[:-1], qd0.shape[:-1])
    law, system = law_of(model, system), system or model.system
    shares, start = (2 if samples else 1), (q0, qd0)
    report = share_of(progress, 0, shares)
    rollout = _run(law, system, start, tau, duration, batch, active, options, report, model=model)
    if samples:
        generator = torch.Generator().manual_seed(seed)
        force = ForceLaw(model.force_samples(samples, generator))
        whole, report = torch.Size((samples, *batch)), share_of(progress, 1, shares)
        disturbance = model.disturbance if options.torque_noise else None
        noise = None if disturbance is None else (disturbance, generator)
        arguments = force, system, start, tau, duration, whole, active, options, report
        sampled = _run(*arguments, batch=batch, noise=noise, model=model)
        rollout = dataclasses.replace(rollout, samples=sampled)
    return _checked(rollout, options)


def replayed(
    model: ForwardModel,
    log: Dataset,
    samples: int = 0,
    seconds: float = float("inf"),
    *,
    seed: int = 0,
    options: RolloutOptions,
    progress: Progress | None = None,
) -> Rollout:
    """Simulate a model from the first state of a logged trajectory to its end, under the logged torques.

    The other arguments are those of `rollout_model`.
    """
    duration = min(seconds, float(log.t[-1] - log.t[0]))
    active, how = log.active(model.system.contact_names)[0], {"options": options, "progress": progress}
    return rollout_model(model, log.q[0], log.qd[0], log, duration, samples, seed=seed, active=active, **how)


def _run(
    law: Law,
    system: ConstrainedSystem,
    start: tuple[Tensor, Tensor],
    tau: Torque,
    duration: float,
    whole: torch.Size,
    active: Tensor | None,
    options: RolloutOptions,
    progress: Progress | None,
    *,
    batch: torch.Size | None = None,
    noise: tuple[Disturbance, torch.Generator] | None = None,
    model: ForwardModel | None = None,
) -> Rollout:
    """Flatten the batch, integrate, and restore the batch shape."""
    n, system = whole.numel(), options.stabilized(system)
    system.robot.check_state(q0=start[0], qd0=start[1])
    unilateral = options.unilateral and len(system.contacts) > 0
    if unilateral and not law.has_multiplier:
        raise ModelError(
            "a model that predicts only accelerations cannot detect the loss of contact",
            hint="pass unilateral=False, or use a model with forces",
        )
    inputs = inputs_of(tau, whole if batch is None else batch, n, options.dt, options.interpolation)
    dt = options.dt or inputs.period or STEP
    steps = max(1, round(duration / dt))
    if noise is not None:
        inputs = Disturbed.drawn(inputs, noise[0], n, steps, dt, noise[1])
    system.announce_states(n * (1 + steps // STEPS_PER_STATE), 1.0, f"{n:,} trajectories of {steps:,} steps")
    mechanics, motion = system, None
    if steps >= COMPILED_STEPS:
        mechanics = compiled_system(system)
        if model is not None and isinstance(law, ForceLaw):
            motion = model.compiled_motion(system, law.force)
    problem = RolloutProblem(mechanics, law, inputs, unilateral, options.sticking, motion)
    with one_thread() if n <= FEW else nullcontext():
        trajectories = integrate(
            problem,
            METHODS[options.method],
            _initial(problem, start, whole, active),
            dt,
            steps,
            project=options.stabilization == "projection",
            speed_limit=options.speed_limit,
            progress=progress,
        )
    shaped = {
        name: getattr(trajectories, name).unflatten(0, whole) if whole else getattr(trajectories, name)[0]
        for name in FIELDS
    }
    return dataclasses.replace(trajectories, system=system, **shaped)


def _initial(
    problem: RolloutProblem, start: tuple[Tensor, Tensor], whole: torch.Size, active: Tensor | None
) -> State:
    """Return the initial states of all trajectories, and the initially closed contacts."""
    n, system = whole.numel(), problem.system
    q, qd = (x.expand(*whole, x.shape[-1]).reshape(n, -1) for x in start)
    if active is not None:
        closed = active.expand(*whole, -1).reshape(n, -1)
    elif problem.unilateral:
        # Contacts are closed if they touch their surface or cannot open.
        with torch.no_grad():
            away = any_row(system, system.equations(q, qd).c.abs() > CLOSED)
        closed = ~(away & system.can_open)
    else:
        closed = torch.ones(n, len(system.contacts), dtype=torch.bool, device=q.device)
    return State(q.new_zeros(n, 1), q, qd, closed)


def share_of(progress: Progress | None, part: int, parts: int) -> Progress | None:
    """Adapt a progress function for one of several runs of equal length."""
    if progress is None:
        return None
    return lambda done, total: progress(part * total + done, parts * total)


def _checked(rollout: Rollout, options: RolloutOptions) -> Rollout:
    for member in (rollout, rollout.samples):
        if options.on_divergence == "raise" and member is not None and member.diverged:
            raise DivergedError(member.diverged, member.rows, rollout)
    return rollout
