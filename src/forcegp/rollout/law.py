"""The right-hand side of a rollout: states, acceleration laws, and sticking joints.

Dry friction lies within ±F if a joint is at rest, and equals −F sign(q̇) if the joint slides. For learning
and differentiation, the equations of motion smooth it to −F tanh(q̇/v₀). A rollout uses the original law. Let
Q(s) be the force in which the direction s of dry friction replaces tanh(q̇/v₀) for each joint. Then

    Q = ½ (Q(1) + Q(−1)) − F s,   F = ½ (Q(−1) − Q(1)).

Over a step h, dry joint friction p changes the velocity to q̇⁺ = q̇ + h (q̈₀ + G p), where q̈₀ is the
frictionless acceleration. Friction satisfies |p_i| ≤ F_i, and p_i = −F_i sign(q̇⁺_i) if the joint slides
(Stewart and Trinkle, *An implicit time-stepping scheme for rigid body dynamics with inelastic collisions and
Coulomb friction*, 1996). In contact, G = H, so that the contact force depends on the friction of sticking
joints. Block principal pivoting solves this complementarity problem exactly (Júdice and Pires, *A block
principal pivoting algorithm for large-scale strictly monotone linear complementarity problems*, 1994). It
guesses which joints stick, solves for their friction, and exchanges joints that contradict the guess.

Let D be the viscous friction of a joint with low inertia. If h G_ii D_i > 1, an explicit step reverses the
motion of the joint, and above 2 it is unstable. Viscous friction is then evaluated at the end of the step
instead of the start, q̈ = q̈₀ + G (p − h D q̈), as in MuJoCo's Euler integrator.
"""

from __future__ import annotations

import contextlib
import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError, NumericalError
from forcegp.forces.posterior import ForcePosterior, ForceSamples
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.contact import CoulombFriction, SurfaceForcePrior, coulomb_response, with_coulomb
from forcegp.forces.priors.joint import AnalyticalMean
from forcegp.forces.quantities import ForceField, States, affine_map
from forcegp.forces.term import NEAR_REST
from forcegp.rollout.cone import accelerating, arrested, sliding_away, sticking_contacts
from forcegp.rollout.inputs import CompiledMotion, ForwardModel, Inputs, Reached

REGULARIZATION = 1e-10
"""Compliance of sticking joints, relative to free joints. It makes friction unique even if more joints stick
    than can move in contact. Joints creep by this fraction of the frictionless motion."""
CONTRADICTION = 1e-9
"""Relative tolerance for forces beyond their limit and for motion against the direction of sliding."""
BLOCK_TRIALS = 5
"""Number of block exchanges without improvement after which joints are exchanged one at a time."""
MAX_EXCHANGES, MOST_JOINTS = 300, 8
"""Maximum number of exchanges, of which arms need fewer than ten, and of joints for which all combinations of
sticking and sliding are tried."""
INSTANT = 1e-12
"""Step size that represents an instant [s], over which every moving joint slides."""
STILL = 1e-8
"""Speed up to which a joint counts as at rest [rad/s, m/s]. Sticking joints creep due to rounding errors."""
SATURATED = 10.0
"""Speed, relative to the scale of smoothed Coulomb friction, above which a contact slides."""
NUDGE = 1e-4
"""Change in speed used to compute the slope of friction [rad/s, m/s]."""


@dataclass(frozen=True, eq=False)
class DryFriction:
    """An impressed force, separated into dry joint friction and all other forces.

    Attributes:
        Q_bar: all other impressed forces, `(n, nq)` [N m, N].
        limit: largest magnitude F ≥ 0 of dry friction, `(n, nq)` [N m, N].
        response: ∂Q̄/∂Q including Coulomb friction at contacts, `(n, nq, nq)`. `None` means the identity.
        damping: D = −∂Q_i/∂q̇_i ≥ 0 of the remaining joint friction, `(n, nq)` [N m s/rad, N s/m].
    """

    Q_bar: Tensor
    limit: Tensor
    response: Tensor | None
    damping: Tensor


def posterior_of(force: ForceField) -> ForcePosterior | None:
    """Return the posterior if a force field is a posterior mean or a set of samples, otherwise `None`."""
    force = force.posterior if isinstance(force, ForceSamples) else force
    return force if isinstance(force, ForcePosterior) else None


def split(system: ConstrainedSystem, at: States, force: ForceField) -> DryFriction:
    """Evaluate a force field at states, and separate the dry friction of joints.

    Args:
        force: the force field Q̄, which is a posterior mean, posterior samples, or a prior mean.

    Example:
        >>> import torch, forcegp
        >>> from forcegp.forces.priors.joint import AnalyticalMean
        >>> from forcegp.forces.quantities import states_at
        >>> system = forcegp.ConstrainedSystem(forcegp.load_robot("franka_panda"))
        >>> at, _ = states_at(system, *torch.zeros(3, 1, 7, dtype=torch.float64), None)
        >>> split(system, at, AnalyticalMean()).limit.shape
        torch.Size([1, 7])
    """
    mean, unknown = force, None
    priors: Sequence[ForcePrior] = ()
    coulomb: Sequence[CoulombFriction] = ()
    if isinstance(force, ForcePosterior | ForceSamples):
        posterior = force if isinstance(force, ForcePosterior) else force.posterior
        process, unknown = posterior.process, force
        mean, priors, coulomb = process.mean, process.priors, process.coulomb
    sticking = [p for p, prior in enumerate(priors) if prior.sticks]
    others = [p for p, prior in enumerate(priors) if not prior.sticks]

    def sliding(direction: Tensor, faster: float = 0.0) -> Tensor:
        moved = dataclasses.replace(at, slip=direction, qd=at.qd + faster * direction)
        force = mean(system, moved)
        return force if unknown is None else force + unknown.unknown_force(system, moved, sticking)

    # Only friction uses the changed speed; the other terms are taken from the equations of motion.
    one = torch.ones_like(at.qd)
    forward, backward = sliding(one), sliding(-one)
    # D = −∂Q/∂q̇ for joints that slide the way s they move: s (Q(q̇) − Q(q̇ + s ε))/ε
    way = torch.where(at.qd < 0.0, -one, one)
    slower = torch.where(at.qd < 0.0, backward, forward)
    damping = (way * (slower - sliding(way, NUDGE)) / NUDGE).clamp(min=0.0)
    limit = 0.5 * (backward - forward)
    # Learned "friction" that drives a joint cannot stick.
    Q = 0.5 * (forward + backward) + limit.clamp(max=0.0).neg() * torch.tanh(at.qd / NEAR_REST)
    if unknown is not None:
        Q = Q + unknown.unknown_force(system, at, others)
    Q_bar = with_coulomb(system, at, Q, coulomb)
    return DryFriction(Q_bar, limit.clamp(min=0.0), coulomb_response(system, at, coulomb), damping)


class Stuck(NamedTuple):
    """Dry friction over a step.

    Attributes:
        force: dry friction p, `(n, nq)` [N m, N].
        held: mask `(n, nq)` of the joints at rest at the end of the step.
        stopping: accelerations that bring the joints to rest at the end of the step, `(n, nq)`.
    """

    force: Tensor
    held: Tensor
    stopping: Tensor


def overshooting(G: Tensor, damping: Tensor, h: Tensor) -> Tensor | None:
    """Return D `(n, nq)` where h G_ii D_i > 1 for any joint and 0 elsewhere, or `None` if all are 0."""
    rows = (h * G.diagonal(dim1=-2, dim2=-1) * damping > 1.0).any(-1, keepdim=True)
    return torch.where(rows, damping, 0.0) if bool(rows.any()) else None


def at_the_end(qdd: Tensor, G: Tensor, damping: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """Return (1 + h G D)⁻¹ q̈₀ and (1 + h G D)⁻¹ G, the motion with damping evaluated at the end of the step.

    Example:
        >>> import torch
        >>> one = torch.ones(1, 1, dtype=torch.float64)
        >>> qdd, _ = at_the_end(-2.0 * one, one[None], 3.0 * one, one)
        >>> qdd.item()
        -0.5
    """
    slowed = torch.eye(G.shape[-1], dtype=G.dtype, device=G.device) + G * (h * damping)[..., None, :]
    both = torch.linalg.solve(slowed, torch.cat([qdd[..., None], G], dim=-1))
    return both[..., 0], both[..., 1:]


def compliance_of(G: Tensor) -> Tensor:
    """Return the acceleration G_ii per unit force of each joint `(n, nq)`, at least 1/1000 of the largest."""
    diagonal = G.diagonal(dim1=-2, dim2=-1)
    return diagonal.clamp(min=1e-3 * diagonal.amax(-1, keepdim=True))


def dry_friction_force(qdd: Tensor, G: Tensor, limit: Tensor, qd: Tensor, h: Tensor) -> Stuck:
    """Return the dry friction of joints with velocity q̇ `(n, nq)` over a step h `(n, 1)` [s].

    The step h is 0 for an instant. `qdd` is the frictionless acceleration, `G` `(n, nq, nq)` the acceleration
    per unit friction (H or M⁻¹), and `limit` `(n, nq)` the largest magnitude F ≥ 0 of friction [N m, N].

    Raises:
        NumericalError: there is no solution because G is not positive definite.

    Example:
        >>> import torch
        >>> one = torch.ones(1, 1, dtype=torch.float64)
        >>> round(dry_friction_force(3.0 * one, one[None], 5.0 * one, 0.0 * one, one).force.item(), 6)
        -3.0
    """
    stopping = -torch.where(qd.abs() > STILL, qd, 0.0) / h.clamp(min=INSTANT)
    free = qdd - stopping
    compliance = compliance_of(G)
    G = G + torch.diag_embed(REGULARIZATION * compliance)
    slack_force = CONTRADICTION * (limit + (free / compliance).abs())
    slack_motion = CONTRADICTION * (free.abs() + compliance * limit)
    problem = free, G, limit, slack_force, slack_motion
    # 0 for joints that stick, ±1 for joints that slide.
    direction = torch.where(limit > 0.0, 0.0, free.sign())
    fewest = torch.full((len(G),), G.shape[-1] + 1, device=G.device)
    trials = torch.full_like(fewest, BLOCK_TRIALS)
    count = fewest
    for _ in range(MAX_EXCHANGES):
        force, over, wrong = _tried(direction, *problem)
        count = wrong.sum(-1)
        if not bool(count.any()):
            return Stuck(force, direction == 0.0, stopping)
        better = count < fewest
        fewest = torch.where(better, count, fewest)
        trials = torch.where(better, BLOCK_TRIALS, trials - 1)
        last = wrong & (wrong.flip(-1).cumsum(-1).flip(-1) == 1)
        exchanged = torch.where((trials >= 0)[:, None], wrong, last)
        direction = torch.where(exchanged, over, direction)
    # Coulomb friction at contacts makes G asymmetric, so exchanges may cycle although a solution exists.
    for row in count.nonzero()[:, 0].tolist():
        direction[row] = _enumerated(*(x[row] for x in problem))
    force, _, wrong = _tried(direction, *problem)
    if not bool(wrong.any()):
        return Stuck(force, direction == 0.0, stopping)
    raise NumericalError(
        "the dry friction of the joints cannot be computed",
        got=f"{int(wrong.any(-1).sum())} of {len(G)} states without a solution",
        hint="a smaller step, or RolloutOptions(sticking=False)",
    )


def _tried(
    direction: Tensor, free: Tensor, G: Tensor, limit: Tensor, slack_force: Tensor, slack_motion: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return friction if joints stick (0) or slide (±1), new directions, and which joints contradict them."""
    sticks = direction == 0.0
    eye = torch.eye(G.shape[-1], dtype=G.dtype, device=G.device)
    rhs = torch.where(sticks, -free, -direction * limit)
    force = torch.linalg.solve_ex(torch.where(sticks[..., None], G, eye), rhs[..., None])[0][..., 0]
    motion = free + (G @ force[..., None])[..., 0]
    over = torch.where(sticks & ~(force.abs() <= limit + slack_force), -force.sign(), 0.0)
    return force, over, (over != 0.0) | (direction * motion < -slack_motion) & ~sticks


def _enumerated(free: Tensor, G: Tensor, limit: Tensor, slack_force: Tensor, slack_motion: Tensor) -> Tensor:
    """Return, for one state, the combination of directions `(nq,)` that the fewest joints contradict."""
    joints = len(limit)
    if joints > MOST_JOINTS:
        return torch.zeros_like(limit)
    directions = torch.cartesian_prod(*[G.new_tensor([0.0, 1.0, -1.0])] * joints).view(-1, joints)
    wrong = _tried(directions, free, G.expand(len(directions), -1, -1), limit, slack_force, slack_motion)[2]
    return directions[wrong.sum(-1).argmin()]


class Law(ABC):
    """A deterministic law that gives the acceleration of a constrained system."""

    has_multiplier: bool

    @abstractmethod
    def motion(self, system: ConstrainedSystem, at: States) -> tuple[Tensor, Tensor]:
        """Return q̈ `(n, nq)` and λ `(n, m)` at states. λ is NaN if the law does not model forces."""

    def dry_friction(self, system: ConstrainedSystem) -> Callable[[States], DryFriction] | None:
        """Return a function that separates dry joint friction from the force, or `None` if there is none.

        Coupled drives do not stick: their dry friction remains a smooth function of their speed.
        """
        return None

    @property
    def rough(self) -> Mapping[str, float]:
        """Contacts with friction, and the speed above which each of them slides [m/s]."""
        return {}

    def knows_friction(self, system: ConstrainedSystem, at: States) -> bool:
        """Return whether contact friction is determined at sliding states, so that sticking can end."""
        return False


@dataclass(frozen=True)
class ForceLaw(Law):
    """The law q̈ = L b + H Q̄ and λ = (A M⁻¹ Aᵀ)⁺(b − A M⁻¹ Q̄) for a force field (eqs. 4 and 16)."""

    force: ForceField
    has_multiplier: bool = True

    def motion(self, system: ConstrainedSystem, at: States) -> tuple[Tensor, Tensor]:
        return at.eom.motion_under(self.force(system, at))

    def dry_friction(self, system: ConstrainedSystem) -> Callable[[States], DryFriction] | None:
        known = posterior_of(self.force)
        mean, priors = (self.force, ()) if known is None else (known.process.mean, known.priors)
        robot = system.robot
        if robot.coupling is not None:
            return None
        in_mean = isinstance(mean, AnalyticalMean) and "friction" in mean.terms
        declared = in_mean and bool(((robot.friction != 0.0) | (robot.stribeck != 0.0)).any())
        if not declared and not any(prior.sticks for prior in priors):
            return None
        return lambda at: split(system, at, self.force)

    @property
    def rough(self) -> Mapping[str, float]:
        known = posterior_of(self.force)
        if known is None:
            return {}
        speeds = {p.contact: 0.0 for p in known.priors if isinstance(p, SurfaceForcePrior)}
        return speeds | {f.contact: SATURATED * float(f.smoothing) for f in known.process.coulomb}

    def knows_friction(self, system: ConstrainedSystem, at: States) -> bool:
        posterior = posterior_of(self.force)
        assert posterior is not None
        with torch.no_grad():
            mean, covariance = posterior.read(system, at, affine_map(system, at, "contact_friction"))
        spread = covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
        return bool((mean.square().sum(-1) > spread).double().mean() > 0.5)


@dataclass(frozen=True)
class AccelerationLaw(Law):
    """An acceleration law given by a model that predicts q̈. The prediction may violate the constraint."""

    model: ForwardModel
    has_multiplier: bool = False

    def motion(self, system: ConstrainedSystem, at: States) -> tuple[Tensor, Tensor]:
        qdd = self.model.predict(at.q, at.qd, at.tau, "qdd", active=at.active, covariance=False).mean
        return qdd, torch.full_like(at.eom.c, torch.nan)


def law_of(model: ForwardModel, system: ConstrainedSystem | None = None) -> Law:
    """Return the law for the mean motion of a model, based on its force field or else its accelerations.

    Raises:
        ModelError: a model that predicts only accelerations cannot predict the motion of a different system.
    """
    trained, force = model.system, model.force_field()
    if force is not None:
        return ForceLaw(force)
    if system is not None and (
        system.robot is not trained.robot or [*system.contacts] != [*trained.contacts]
    ):
        raise ModelError(
            f"this model ({model.kind}) predicts accelerations only for the system to which it was fitted",
            expected=_described(trained),
            got=f"another system: {_described(system)}",
            hint="omit `system`, or use a model of forces such as StructuredGP",
        )
    return AccelerationLaw(model)


def _described(system: ConstrainedSystem) -> str:
    return f"robot {system.robot.name!r} with contacts {', '.join(system.contact_names) or '(none)'}"


class State(NamedTuple):
    """States of n trajectories. Their times may differ because of events within a step.

    Attributes:
        t: time, `(n, 1)` [s].
        q, qd: positions and velocities, `(n, nq)`.
        active: mask `(n, n_contacts)` of closed contacts.
    """

    t: Tensor
    q: Tensor
    qd: Tensor
    active: Tensor

    def where(self, rows: Tensor, other: State) -> State:
        """Return this state in the given rows `(n,)`, and the state `other` in all other rows."""
        return State(*(torch.where(rows[:, None], a, b) for a, b in zip(self, other, strict=True)))


class Instant(NamedTuple):
    """Motion at a state.

    Attributes:
        tau, qdd: motor torque and acceleration, `(n, nq)`.
        multiplier, c, cd: λ, the constraint error and its rate, `(n, m)`.
        held: mask `(n, nq)` of joints at rest at the end of the step, `None` without dry friction.
    """

    tau: Tensor
    qdd: Tensor
    multiplier: Tensor
    c: Tensor
    cd: Tensor
    held: Tensor | None = None


@dataclass(frozen=True)
class RolloutProblem:
    """The equations q̈ = law(q, q̇, τ(t, q, q̇)) on a constrained system with the rollout's stabilization.

    If `unilateral` is true, contacts with a surface can open and close. If `sticking` is true, dry friction
    can hold joints. If no gradient is required, `compiled` computes the motion in C.
    """

    system: ConstrainedSystem
    law: Law
    inputs: Inputs
    unilateral: bool
    sticking: bool = False
    compiled: CompiledMotion | None = None

    _known: list[bool] = field(default_factory=list, init=False)

    @cached_property
    def rough(self) -> Mapping[str, float]:
        """Contacts with friction that may stick, and the speed above which each of them slides [m/s]."""
        speeds = {contact.name: contact.stick_speed or 0.0 for _, contact, _ in self.system.may_stick}
        known = self.law.rough if speeds else {}
        return {name: max(speeds[name], known[name]) for name in speeds if name in known}

    @cached_property
    def dry_friction(self) -> Callable[[States], DryFriction] | None:
        """Function that separates dry joint friction from the force, or `None` without dry friction."""
        return self.law.dry_friction(self.system) if self.sticking else None

    def evaluate(self, state: State, end: Tensor) -> Instant:
        """Return the motion at a state within a step that ends at the time `end`, `(n, 1)`."""
        at, h = Reached(self.system, state.q, state.qd, state.active), end - state.t
        tau = self.inputs.torque(state.t, end, at)
        if self.compiled is not None and not any(x.requires_grad for x in (state.q, state.qd, tau)):
            sticks = self.dry_friction is not None
            with contextlib.suppress(NumericalError):  # more is tried below
                qdd, multiplier, c, cd, held = self.compiled(state.q, state.qd, tau, state.active, h, sticks)
                return Instant(tau, qdd, multiplier, c, cd, held if sticks else None)
        acting = self.system.robot.true_torque(tau)
        return self._reached(States(state.q, state.qd, acting, state.active, at.eom), h)._replace(tau=tau)

    def _reached(self, at: States, h: Tensor) -> Instant:
        """Return the motion at states, in which contacts with friction may stick over a step h `(n, 1)`."""
        now, rough = self._instant(at, h), self.rough
        if not rough or not bool((sticks := sticking_contacts(self.system, at, rough)).any()):
            return now
        away = sliding_away(self.system, at, now.multiplier, sticks, rough)
        if not self._known:
            self._known.append(self.law.knows_friction(self.system, away))
        if not self._known[0]:
            return now
        slides = sticks & accelerating(self.system, at, now.multiplier, self._instant(away, h).qdd)
        if not bool(slides.any()):
            return now
        return self._instant(sliding_away(self.system, at, now.multiplier, slides, rough), h)

    def stopped(self, before: State, after: State) -> State:
        """Return the state after a step, in which contacts that friction has stopped are at rest."""
        if not self.rough:
            return after
        first, last = (self.system.equations(x.q, x.qd, x.active) for x in (before, after))
        closed = before.active & after.active
        return after._replace(qd=arrested(self.system, self.rough, first, last, closed, after.qd))

    def _instant(self, at: States, h: Tensor) -> Instant:
        """Return the motion at states, with friction evaluated over a step h `(n, 1)` [s]."""
        eom, tau = at.eom, at.tau
        if self.dry_friction is None:
            qdd, multiplier = self.law.motion(self.system, at)
            return Instant(tau, qdd, multiplier, eom.c, eom.cd)
        dry = self.dry_friction(at)
        free = eom.acceleration(dry.Q_bar)
        G = eom.H if dry.response is None else eom.H @ dry.response
        damping = overshooting(G, dry.damping, h)
        if damping is not None:
            free, G = at_the_end(free, G, damping, h)
        force, held, stopping = dry_friction_force(free, G, dry.limit, at.qd, h)
        if damping is not None:
            force = force - h * damping * (free + (G @ force[..., None])[..., 0])
        impressed = force if dry.response is None else (dry.response @ force[..., None])[..., 0]
        qdd, multiplier = eom.motion_under(dry.Q_bar + impressed)
        qdd = torch.where(held, stopping, qdd)  # equal up to rounding errors
        return Instant(tau, qdd, multiplier, eom.c, eom.cd, held)


Step = Callable[[RolloutProblem, State, Instant, Tensor], State]
"""A function that advances a state with known motion by steps h `(n, 1)` [s]."""
