"""Forces at a surface contact: tangential, normal, and Coulomb friction proportional to the multiplier.

Contact forces do not depend on the world axes. Tangential vectors have two coordinates in a tangent frame of
the surface. At normal n, this frame is (R e_x, R e_y), where R is the smallest rotation that maps e_z to n.
Forces learned on one surface therefore transfer to a raised, tilted or curved surface. A force normal to the
surface does not change the accelerations.

Friction proportional to the normal force couples the force and the multiplier. For a single contact with u =
−J_Eᵀ s(v) and g = Lᵀ u, the equations λ = λ_K − Lᵀ Q_z and Q_z = μ λ u have the solution λ = λ_K / (1 + μ g),
where λ_K is the multiplier without friction. Latent functions must enter the force linearly, but μ does not.
The operator is therefore the secant u λ_K / (1 + μ̂ g) at a given μ̂.

For a learned constant coefficient, the coupling is exact. Let Q_z = Q_z′ + U λ, where a contact with friction
coefficient μ has the column μ u, and let λ₀ = (A M⁻¹ Aᵀ)⁺ b − Lᵀ (Q + Q_z′) be the multiplier without this
friction. Then λ = λ₀ − LᵀU λ has the solution λ = (I + LᵀU)⁻¹ λ₀. For given μ, every quantity therefore
remains an affine map of the forces, in which B_Q, B_z and o are replaced by

    B_Q − G Lᵀ,  B_z − G Lᵀ,  o + G (A M⁻¹ Aᵀ)⁺ b   with   G = B_z U (I + LᵀU)⁻¹.

The learned μ and ε are uncertain. To first order in their errors δ, friction at fixed λ changes by ∂(μ u
λ)/∂(log μ, log ε) δ. λ responds to this contact force as to any other, so δ is an additional latent force.
The joint posterior of all latent forces is a Laplace approximation that marginalises δ, and the variance of
every quantity z includes (∂z/∂δ)² Var δ.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.linalg import vecdot

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.contact import SurfaceContact
from forcegp.constraints.gauss import ContactPoint, tangent_frame
from forcegp.errors import ModelError
from forcegp.forces.measurements import Measurement
from forcegp.forces.priors.base import CONSTRAINT, CONTACT, COULOMB, ForcePrior, check_inputs
from forcegp.forces.priors.joint import ConstantForcePrior, JointForcePrior
from forcegp.forces.quantities import AffineMap, States
from forcegp.forces.term import ExpectedForce
from forcegp.gp.kernels import Constant, Kernel, SquaredExponential
from forcegp.robot.model import RobotModel

WIDTHS = {"position": 2, "velocity": 2, "speed": 1}
"""Number of columns of each input: tangential coordinates of the contact point [m] and of its velocity [m/s],
and sliding speed [m/s].
"""
TERMS = ("viscous", "dry", "coulomb", "stribeck", "torsion")
"""Friction terms, in the order of the components of the latent function."""
LOADED = ("coulomb", "stribeck", "torsion")
"""Friction terms proportional to the multiplier."""


@dataclass(frozen=True)
class SurfaceForcePrior(ForcePrior):
    """A prior on a force at a closed, sliding surface contact."""

    contact: str
    kernel: Kernel = field(default_factory=SquaredExponential)
    inputs: tuple[str, ...] = ("position", "velocity")
    name: str = ""
    target: str = CONTACT

    vectors = ("position", "velocity")

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.name or f"contact_{self.contact}")
        check_inputs(self.name, self.inputs, tuple(WIDTHS))

    def check(self, system: ConstrainedSystem) -> None:
        if not isinstance(system.contact(self.contact), SurfaceContact):
            raise ModelError(
                f"contact {self.contact!r} has no surface, so no tangential force",
                expected="a SurfaceContact",
                got=type(system.contact(self.contact)).__name__,
            )

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        if not system.contacts:
            return {name: at.q.new_zeros(len(at.q), WIDTHS[name]) for name in self.inputs}
        point = self._touching(system, at)
        return {name: _along(point, name) for name in self.inputs}

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        if not system.contacts:
            return at.q.new_zeros(*at.q.shape, self.outputs(system.robot))
        sticks = self._touching(system, at).sticks
        open_ = at.active[:, system.contact_names.index(self.contact)].logical_not()
        open_ = open_ if sticks is None else open_ | sticks
        return self.directions(system, at).masked_fill(open_[:, None, None], 0.0)

    @abstractmethod
    def directions(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Return E(x) `(n, nq, outputs)` while the contact is closed and slides."""

    def _touching(self, system: ConstrainedSystem, at: States) -> ContactPoint:
        """Return the contact point. If the contact has none, raise the errors of `check`."""
        if self.contact not in at.eom.contact_points:
            self.check(system)
        return at.eom.contact_points[self.contact]


def _along(point: ContactPoint, name: str) -> Tensor:
    """Return an input on the surface: the tangential `position` or `velocity`, or the sliding `speed`."""
    if name == "speed":
        # The floor keeps the derivative of the root finite at rest.
        return point.sliding[1].square().sum(-1, keepdim=True).clamp(min=1e-30).sqrt()
    return (tangent_frame(point.unit_normal).mT @ getattr(point, name)[..., None])[..., 0]


@dataclass(frozen=True)
class ContactForcePrior(SurfaceForcePrior):
    """A prior on the dissipative tangential force at a contact, F_z = t_1 f_1 + t_2 f_2.

    E = J_Eᵀ (t_1, t_2) while the contact is closed, and E = 0 otherwise. t_1 and t_2 span the tangent plane
    at the contact point (`tangent_frame`).

    Args:
        contact: name of a surface contact of the system.
        kernel: covariance of each component.
        inputs: inputs of the force, chosen from the tangential `position`, `velocity` and `speed`.
        name: prefix of the hyperparameters; defaults to the name of the contact.
        scaled: whether to standardize the inputs, which the paper does not do.

    Example:
        >>> ContactForcePrior("table").target
        'contact'

    Raises:
        UnknownNameError: an input is not one of the three.
    """

    scaled: bool = field(default=True, kw_only=True)

    def outputs(self, robot: RobotModel) -> int:
        return 2

    def directions(self, system: ConstrainedSystem, at: States) -> Tensor:
        point = at.eom.contact_points[self.contact]
        return point.jacobian.mT @ tangent_frame(point.unit_normal)


@dataclass(frozen=True)
class SlidingFrictionPrior(SurfaceForcePrior):
    """A prior on friction that opposes sliding, with v = (1 − n nᵀ) ṗ_E and s(v) = v / √(|v|² + ε²).

    F_z = −θ_v v − (θ_d + λ (μ + μ_s e^{−|v|²/v_s²})) s(v). The moment about the normal is −θ_t λ s(ω_n) n.

    The unknowns are the scalar functions listed in `terms`: `viscous` θ_v [N s/m], `dry` θ_d [N], `coulomb`
    μ, `stribeck` μ_s and `torsion` θ_t [m]. They require fewer samples than the components of a force. By
    default, they depend on the sliding speed, so they transfer to surfaces with any position, tilt and shape.

    λ = max(λ_K, 0) / (1 + μ̂ g), where λ_K is the frictionless multiplier under the analytical forces Q_K +
    τ, and g = −Lᵀ J_Eᵀ s(v). This is exact for a single contact with friction −μ̂ λ s(v). In all other cases,
    second-order terms are neglected: μ (μ − μ̂), and the products of μ with other friction at the contact,
    friction at other contacts, and unknown joint forces. If unknown joint forces are large, use `dry`, or
    learn these forces as analytical parameters.

    Args:
        contact: name of a surface contact of the system.
        kernel: covariance of each unknown.
        inputs: inputs of the functions, chosen from `position`, `velocity` and `speed`.
        name: prefix of the hyperparameters; defaults to the name of the contact.
        smoothing: smoothing speed ε [m/s].
        terms: friction terms.
        friction_coefficient: friction coefficient μ̂.
        stribeck_speed: Stribeck speed v_s [m/s].
        torsion_smoothing: smoothing angular speed of torsional friction about the normal [rad/s].
        coupled: whether to include Coulomb friction −μ λ s(v) in addition to `terms`. Its μ is constant and
            is learned together with its ε (`forces/priors/contact.py`).

    Raises:
        UnknownNameError: an input or a friction term is unknown.
        ModelError: a speed is not positive, or the friction coefficient is negative.

    Example:
        >>> SlidingFrictionPrior("table", terms=("viscous", "coulomb")).terms
        ('viscous', 'coulomb')
    """

    kernel: Kernel = field(default_factory=lambda: SquaredExponential(shared=True))
    inputs: tuple[str, ...] = ("speed",)
    smoothing: float = 0.01
    terms: tuple[str, ...] = ("viscous", "dry")
    friction_coefficient: float = 0.0
    stribeck_speed: float = 0.05
    torsion_smoothing: float = 0.1
    coupled: bool = False

    commensurate = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_inputs(f"{self.name}.terms", self.terms, TERMS)
        if len(set(self.terms)) < len(self.terms):
            raise ModelError(f"force prior {self.name!r} has a duplicate friction term", got=self.terms)
        speeds = {"smoothing speed": self.smoothing, "Stribeck speed": self.stribeck_speed}
        for what, value in (speeds | {"torsional smoothing speed": self.torsion_smoothing}).items():
            if not 0.0 < value < float("inf"):
                raise ModelError(
                    f"force prior {self.name!r} has an invalid {what}",
                    expected="a positive finite speed [m/s, rad/s]",
                    got=value,
                )
        if not 0.0 <= self.friction_coefficient < float("inf"):
            raise ModelError(
                f"force prior {self.name!r} has an invalid friction coefficient",
                expected="a finite number, 0 or above",
                got=self.friction_coefficient,
            )

    def outputs(self, robot: RobotModel) -> int:
        return len(self.terms)

    def directions(self, system: ConstrainedSystem, at: States) -> Tensor:
        J, v = at.eom.contact_points[self.contact].sliding
        square = v.square().sum(-1, keepdim=True)
        against = -vecdot(J, v[..., None], dim=-2)
        dry = against / (square + self.smoothing**2).sqrt()
        columns = {"viscous": against, "dry": dry}
        if set(self.terms) & set(LOADED):
            load = self._load(system, at, dry)
            columns["coulomb"] = load * dry
            columns["stribeck"] = columns["coulomb"] * torch.exp(-square / self.stribeck_speed**2)
            if "torsion" in self.terms:
                columns["torsion"] = load * self._spin(system, at)
        return torch.stack([columns[term] for term in self.terms], dim=-1)

    def _load(self, system: ConstrainedSystem, at: States, u: Tensor) -> Tensor:
        """Return the multiplier `(n, 1)` under the analytical forces and the friction μ̂ λ u."""
        contact = system.contact_names.index(self.contact)
        row = system.rows[self.contact].start
        free = at.eom.multiplier(at.eom.Q_K + at.tau)[:, row].clamp(min=0.0)
        gain = 1.0 + self.friction_coefficient * (at.eom.L[..., row] * u).sum(-1)
        if bool((gain[at.active[:, contact]] <= 0.0).any()):
            raise ModelError(
                f"contact {self.contact!r} jams with a friction coefficient of {self.friction_coefficient:g}",
                hint="use a smaller friction_coefficient",
            )
        return (free / gain)[:, None]

    def _spin(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Return the generalized force `(n, nq)` of a unit moment that opposes rotation about the normal."""
        contact = system.contact(self.contact)
        assert isinstance(contact, SurfaceContact)
        index = system.robot.frame_index(contact.frame)
        origin = kinematics.as_point(system.robot, contact.point)
        angular = kinematics.jacobian_of_poses(system.robot, at.eom.poses, index, origin)[..., :3, :]
        about = (at.eom.contact_points[self.contact].unit_normal[..., None, :] @ angular)[..., 0, :]
        rate = (about * at.qd).sum(-1, keepdim=True)
        return -about * rate / (rate.square() + self.torsion_smoothing**2).sqrt()


@dataclass(frozen=True)
class NormalForcePrior(ForcePrior):
    """A prior on a joint force along the constraint, which does not affect accelerations in contact.

    E = Aᵀ Lᵀ = I − P. Since H Aᵀ = 0, a force Aᵀ g(x) changes the multiplier by −g(x) but does not change the
    accelerations. A joint force prior alone is overconfident along the normal. This prior adds an independent
    process with the same hyperparameters, so the normal force remains uncertain unless it is measured.

    Args:
        like: the joint force prior that provides the kernel, inputs and hyperparameters.

    Example:
        >>> from forcegp.priors import JointForcePrior
        >>> NormalForcePrior(JointForcePrior()).target
        'constraint'
    """

    like: JointForcePrior = field(default_factory=JointForcePrior)
    target: str = CONSTRAINT

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", f"{self.like.name}_normal")
        for name in ("kernel", "scaled"):
            object.__setattr__(self, name, getattr(self.like, name))

    @property
    def prefix(self) -> str:
        return self.like.name

    def outputs(self, robot: RobotModel) -> int:
        return self.like.outputs(robot)

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        return self.like.features(system, at)

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        return at.eom.A.mT @ at.eom.L.mT


SHARP = 1e-6
"""Smoothing speed at which friction has almost its full magnitude [m/s]."""
FRICTION_COEFFICIENT = 0.2
"""Initial value of a learned friction coefficient."""
NEARLY_JAMMED = 0.95
"""Largest friction coefficient, relative to the coefficient at which the contact jams."""
LEARNED = 2
"""Number of learned friction parameters per contact, μ and ε."""


@dataclass(frozen=True, eq=False)
class CoulombFriction:
    """Coulomb friction −μ λ s(v) at a surface contact, with s(v) = v / √(|v|² + ε²).

    Attributes:
        contact: name of the contact.
        coefficient: friction coefficient μ.
        smoothing: smoothing speed ε [m/s].
    """

    contact: str
    coefficient: Tensor
    smoothing: Tensor


def coulomb_keys(contact: str) -> tuple[str, str]:
    """Return the names of the learned friction coefficient and smoothing speed of a contact."""
    return f"{COULOMB}.{contact}.log_coefficient", f"{COULOMB}.{contact}.log_smoothing"


def initial_coulomb(priors: Iterable[ForcePrior], like: Tensor) -> dict[str, Tensor]:
    """Return initial values of learned friction for contacts with a prior coupled to the multiplier."""
    start = {}
    for prior in _coupled_priors(priors):
        coefficient, smoothing = coulomb_keys(prior.contact)
        start[coefficient] = like.new_tensor(math.log(FRICTION_COEFFICIENT))
        start[smoothing] = like.new_tensor(math.log(prior.smoothing))
    return start


def coulomb_of(
    priors: Sequence[ForcePrior], tensors: Mapping[str, Tensor], like: Tensor
) -> tuple[CoulombFriction, ...]:
    """Return contact friction with learned parameters, or with initial values if they are missing."""
    values = initial_coulomb(priors, like) | dict(tensors)
    return tuple(
        CoulombFriction(prior.contact, *(values[key].exp() for key in coulomb_keys(prior.contact)))
        for prior in _coupled_priors(priors)
    )


def _coupled_priors(priors: Iterable[ForcePrior]) -> list[SlidingFrictionPrior]:
    return [p for p in priors if isinstance(p, SlidingFrictionPrior) and p.coupled]


@dataclass(frozen=True, eq=False)
class CoulombErrorPrior(ConstantForcePrior):
    """A prior on the error of learned friction, Q_z = λ̂ ∂(μ u)/∂(log μ, log ε) δ with δ ~ N(0, 1).

    λ̂ is the multiplier under the analytical forces, the expected forces of learned terms of the joints, and
    the learned friction. Without the expected forces, joint friction that the robot file lacks would be
    mistaken for a changing load: in six simulated logs, the largest error of μ would be 5.6 σ, not 2.4 σ.
    The unit standard deviation of δ is about the width of the weak priors on log μ and log ε
    (`learning/search.py`).

    Attributes:
        contact: name of the contact with uncertain friction.
        friction: learned friction of all contacts, which determines λ̂.
        expected: the force that learned terms are expected to have.
    """

    contact: str
    friction: tuple[CoulombFriction, ...]
    expected: ExpectedForce = field(default_factory=ExpectedForce)
    kernel: Kernel = field(default_factory=lambda: Constant(group=LEARNED))
    target: str = CONTACT

    @property
    def name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return f"{COULOMB}_error_{self.contact}"

    def outputs(self, robot: RobotModel) -> int:
        return LEARNED

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        if self.contact not in system.contact_names:
            return at.q.new_zeros(*at.q.shape, LEARNED)
        law = next(f for f in self.friction if f.contact == self.contact)
        v = at.eom.contact_points[self.contact].sliding[1]
        u = against_sliding(at, self.contact, law.smoothing)
        # μ λ̂, with λ̂ under Q_C + Q_G + Q_D + Q_u + Q̂ and all friction
        Q_bar = with_coulomb(system, at, at.eom.Q_K + at.tau + self.expected(system, at), self.friction)
        load = law.coefficient * at.eom.multiplier(Q_bar)[:, system.rows[self.contact].start]
        # ∂(μ u)/∂log μ = μ u, ∂s/∂log ε = −s ε²/(|v|² + ε²)
        fading = law.smoothing**2 / (v.square().sum(-1) + law.smoothing**2)
        return torch.stack([load, -load * fading], dim=-1)[:, None, :] * u[..., None]


def against_sliding(at: States, contact: str, smoothing: Tensor | float) -> Tensor:
    """Return u = −J_Eᵀ s(v) `(n, nq)`, the generalized force of a unit friction force."""
    # s = v/√(|v|² + ε²); where the point sticks, its force is a multiplier
    point = at.eom.contact_points[contact]
    J, v = point.sliding
    u = -(J.mT @ (v / (v.square().sum(-1, keepdim=True) + smoothing**2).sqrt())[..., None])[..., 0]
    return u if point.sticks is None else u.masked_fill(point.sticks[..., None], 0.0)


def coupled(
    system: ConstrainedSystem, at: States, z: AffineMap, friction: Sequence[CoulombFriction]
) -> AffineMap:
    """Include Coulomb friction at the contacts in the affine map of a quantity.

    Args:
        system: robot and contacts; friction of other contacts is ignored.
        z: affine map of the quantity without this friction.
        friction: Coulomb friction of the contacts.
    """
    gain = _gain(system, at, friction)
    if gain is None:
        return z
    # G = B_z U (I + LᵀU)⁻¹; B_Q − G Lᵀ, B_z − G Lᵀ, o + G (A M⁻¹ Aᵀ)⁺ b
    G = z.B_z @ gain
    back = G @ at.eom.L.mT
    offset = (G @ (at.eom.constraint_inertia @ at.eom.b[..., None]))[..., 0]
    B_N = -back if z.B_N is None else z.B_N - back
    return AffineMap(z.B_Q - back, z.B_z - back, B_N, z.o + offset, z.B_F)


def with_coulomb(
    system: ConstrainedSystem, at: States, Q_bar: Tensor, friction: Sequence[CoulombFriction]
) -> Tensor:
    """Add Coulomb friction at the contacts to impressed forces Q̄ `(n, nq)`."""
    gain = _gain(system, at, friction)
    if gain is None:
        return Q_bar
    # λ₀ = (A M⁻¹ Aᵀ)⁺ (b − A M⁻¹ Q̄′), Q̄ = Q̄′ + U (I + LᵀU)⁻¹ λ₀
    return Q_bar + (gain @ at.eom.multiplier(Q_bar)[..., None])[..., 0]


def coulomb_response(
    system: ConstrainedSystem, at: States, friction: Sequence[CoulombFriction]
) -> Tensor | None:
    """Return ∂Q̄/∂Q = I − G Lᵀ `(n, nq, nq)`, the response of friction to joint forces; `None` if it is I."""
    gain = _gain(system, at, friction)
    if gain is None:
        return None
    return torch.eye(at.q.shape[-1], dtype=at.q.dtype, device=at.q.device) - gain @ at.eom.L.mT


@torch.no_grad()
def below_jamming(
    system: ConstrainedSystem,
    measurements: Sequence[Measurement],
    priors: Iterable[ForcePrior],
    bounds: Mapping[str, tuple[float, float]],
) -> dict[str, tuple[float, float]]:
    """Return bounds on μ that exclude jamming at all sliding training states, that is, 1 + μ Lᵀu > 0."""
    changed = dict(bounds)
    for prior in _coupled_priors(priors):
        key, row = coulomb_keys(prior.contact)[0], system.rows[prior.contact].start
        if key in changed:
            # Lᵀu, the load relief by a unit friction force
            states = (m.at(system) for m in measurements)
            pairs = ((at.eom.L[..., row], against_sliding(at, prior.contact, SHARP)) for at in states)
            gains = [(L * u).sum(-1) for L, u in pairs]
            # 1 + μ Lᵀu > 0, so μ < −1/Lᵀu wherever Lᵀu < 0
            worst = float(torch.cat(gains).min())
            low, high = changed[key]
            if worst < 0.0:
                changed[key] = low, max(low, min(high, math.log(-NEARLY_JAMMED / worst)))
    return changed


def _gain(system: ConstrainedSystem, at: States, friction: Sequence[CoulombFriction]) -> Tensor | None:
    """Return U (I + LᵀU)⁻¹ `(n, nq, m)`, which maps the frictionless multiplier to friction, or `None`."""
    present = {f.contact: f for f in friction if f.contact in system.contact_names}
    if not present:
        return None
    # U = (μ u of each contact, 0 without friction)
    columns = []
    for contact in system.contacts:
        column, law = at.q.new_zeros(*at.q.shape, contact.rows), present.get(contact.name)
        if law is not None:
            u = law.coefficient * against_sliding(at, contact.name, law.smoothing)
            column = column.select_scatter(u, -1, 0)
        columns.append(column)
    # G (I + LᵀU) = U
    U = torch.cat(columns, dim=-1)
    eye = torch.eye(U.shape[-1], dtype=U.dtype, device=U.device)
    return torch.linalg.solve(eye + at.eom.L.mT @ U, U, left=False)
