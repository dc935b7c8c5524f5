"""Coulomb friction of contacts that is proportional to the multiplier, coupled with it exactly.

Let Q_z = Q_z′ + U λ, where a contact with friction coefficient μ has the column μ u, u = −J_Eᵀ s(v), and let
λ₀ = (A M⁻¹ Aᵀ)⁺ b − Lᵀ (Q + Q_z′) be the multiplier without this friction. Then λ = λ₀ − LᵀU λ has the
solution λ = (I + LᵀU)⁻¹ λ₀. So at a given μ every quantity remains an affine map of the forces: its operators
and offset B_Q, B_z, o become

    B_Q − G Lᵀ,  B_z − G Lᵀ,  o + G (A M⁻¹ Aᵀ)⁺ b   with   G = B_z U (I + LᵀU)⁻¹.

Learned μ and ε are uncertain. To first order in their errors δ, friction changes at fixed λ by
∂(μ u λ)/∂(log μ, log ε) δ, a contact force to which λ responds as to any other. So δ is one more latent
force; the posterior over all of them is a Laplace approximation that marginalises δ, and the variance of
every quantity z contains (∂z/∂δ)² Var δ.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.measurements import Measurement
from forcegp.forces.priors.base import CONTACT, COULOMB, ForcePrior
from forcegp.forces.priors.contact import SlidingFrictionPrior
from forcegp.forces.quantities import AffineMap, States
from forcegp.gp.kernels import Constant, Kernel
from forcegp.robot.model import RobotModel

SHARP = 1e-6
"""A smoothing speed so small that all friction has its full size [m/s]."""


FRICTION_COEFFICIENT = 0.2
"""Where learning a friction coefficient begins."""
NEARLY_JAMMED = 0.95
"""Largest friction coefficient that is considered, relative to the one at which the contact jams."""
LEARNED = 2
"""Numbers that are learned of the friction of a contact: μ and ε."""


@dataclass(frozen=True, eq=False)
class CoulombFriction:
    """Friction −μ λ s(v) of a contact with a surface, s(v) = v / √(|v|² + ε²).

    Attributes:
        contact: name of the contact.
        coefficient: μ, a scalar.
        smoothing: ε, a scalar [m/s].
    """

    contact: str
    coefficient: Tensor
    smoothing: Tensor


def coulomb_keys(contact: str) -> tuple[str, str]:
    """Names of the learned friction coefficient and smoothing speed of a contact."""
    return f"{COULOMB}.{contact}.log_coefficient", f"{COULOMB}.{contact}.log_smoothing"


def initial_coulomb(priors: Iterable[ForcePrior], like: Tensor) -> dict[str, Tensor]:
    """Where learning friction begins, for contacts whose prior is coupled with the multiplier."""
    start = {}
    for prior in _coupled_priors(priors):
        coefficient, smoothing = coulomb_keys(prior.contact)
        start[coefficient] = like.new_tensor(math.log(FRICTION_COEFFICIENT))
        start[smoothing] = like.new_tensor(math.log(prior.smoothing))
    return start


def coulomb_of(
    priors: Sequence[ForcePrior], tensors: Mapping[str, Tensor], like: Tensor
) -> tuple[CoulombFriction, ...]:
    """Friction at learned tensors, or where its learning begins if it is not among them."""
    values = initial_coulomb(priors, like) | dict(tensors)
    return tuple(
        CoulombFriction(prior.contact, *(values[key].exp() for key in coulomb_keys(prior.contact)))
        for prior in _coupled_priors(priors)
    )


def _coupled_priors(priors: Iterable[ForcePrior]) -> list[SlidingFrictionPrior]:
    return [p for p in priors if isinstance(p, SlidingFrictionPrior) and p.coupled]


@dataclass(frozen=True, eq=False)
class CoulombErrorPrior(ForcePrior):
    """Q_z = λ̂ ∂(μ u)/∂(log μ, log ε) δ, δ ~ N(0, 1): what learning leaves unknown of a contact's friction.

    λ̂ is the multiplier of the analytical forces with the learned friction. One e-fold is about the width of
    the weak priors that μ and ε are learned with (`forces/start.py`).

    Attributes:
        contact: whose friction is uncertain.
        friction: learned friction of all contacts, on which λ̂ depends.
    """

    contact: str
    friction: tuple[CoulombFriction, ...]
    kernel: Kernel = field(default_factory=lambda: Constant(group=LEARNED))
    target: str = CONTACT

    @property
    def name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return f"{COULOMB}_error_{self.contact}"

    def outputs(self, robot: RobotModel) -> int:
        return LEARNED

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        return {"one": torch.zeros_like(at.q[:, :1])}

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        if self.contact not in system.contact_names:
            return at.q.new_zeros(*at.q.shape, LEARNED)
        law = next(f for f in self.friction if f.contact == self.contact)
        v, u = (
            at.eom.contact_points[self.contact].sliding[1],
            against_sliding(at, self.contact, law.smoothing),
        )
        # μ λ̂, with λ̂ under Q_C + Q_G + Q_D + Q_u and all friction
        Q_bar = with_coulomb(system, at, at.eom.Q_K + at.tau, self.friction)
        load = law.coefficient * at.eom.multiplier(Q_bar)[:, _row(system, self.contact)]
        # ∂(μ u)/∂log μ = μ u, ∂s/∂log ε = −s ε²/(|v|² + ε²)
        fading = law.smoothing**2 / (v.square().sum(-1) + law.smoothing**2)
        return torch.stack([load, -load * fading], dim=-1)[:, None, :] * u[..., None]


def against_sliding(at: States, contact: str, smoothing: Tensor | float) -> Tensor:
    """u = −J_Eᵀ s(v), the generalized force of a unit friction force, `(n, nq)`."""
    # s = v/√(|v|² + ε²)
    J, v = at.eom.contact_points[contact].sliding
    return -(J.mT @ (v / (v.square().sum(-1, keepdim=True) + smoothing**2).sqrt())[..., None])[..., 0]


def coupled(
    system: ConstrainedSystem, at: States, z: AffineMap, friction: Sequence[CoulombFriction]
) -> AffineMap:
    """The affine map of a quantity where contacts have Coulomb friction.

    Args:
        system: robot and contacts; friction of contacts that it does not have is left out.
        at: n states.
        z: the quantity without this friction.
        friction: of each contact that has one.
    """
    gain = _gain(system, at, friction)
    if gain is None:
        return z
    # G = B_z U (I + LᵀU)⁻¹; B_Q − G Lᵀ, B_z − G Lᵀ, o + G (A M⁻¹ Aᵀ)⁺ b
    G = z.B_z @ gain
    back = G @ at.eom.L.mT
    offset = (G @ (at.eom.constraint_inertia @ at.eom.b[..., None]))[..., 0]
    return AffineMap(z.B_Q - back, z.B_z - back, -back if z.B_N is None else z.B_N - back, z.o + offset)


def with_coulomb(
    system: ConstrainedSystem, at: States, Q_bar: Tensor, friction: Sequence[CoulombFriction]
) -> Tensor:
    """All impressed forces Q̄ `(n, nq)`, Coulomb friction included, from those without it."""
    gain = _gain(system, at, friction)
    if gain is None:
        return Q_bar
    # λ₀ = (A M⁻¹ Aᵀ)⁺ (b − A M⁻¹ Q̄′), Q̄ = Q̄′ + U (I + LᵀU)⁻¹ λ₀
    return Q_bar + (gain @ at.eom.multiplier(Q_bar)[..., None])[..., 0]


def coulomb_response(
    system: ConstrainedSystem, at: States, friction: Sequence[CoulombFriction]
) -> Tensor | None:
    """∂Q̄/∂Q = I − G Lᵀ `(n, nq, nq)`: a joint force changes the contact's load; `None` for identity."""
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
    """Bounds with which no contact jams, 1 + μ Lᵀu > 0, in a state in which it was seen to slide."""
    changed = dict(bounds)
    for prior in _coupled_priors(priors):
        key, row = coulomb_keys(prior.contact)[0], _row(system, prior.contact)
        if key in changed:
            gains = [_drag(m.at(system), prior.contact, row) for m in measurements]
            # 1 + μ Lᵀu > 0, so μ < −1/Lᵀu wherever Lᵀu < 0
            worst = float(torch.cat(gains).min())
            low, high = changed[key]
            if worst < 0.0:
                changed[key] = low, max(low, min(high, math.log(-NEARLY_JAMMED / worst)))
    return changed


def _drag(at: States, contact: str, row: int) -> Tensor:
    """Lᵀu of a contact `(n,)`: how much a unit friction force relieves it, negative where it presses."""
    return (at.eom.L[..., row] * against_sliding(at, contact, SHARP)).sum(-1)


def _row(system: ConstrainedSystem, contact: str) -> int:
    """Row of a contact among the multipliers."""
    return sum(c.rows for c in system.contacts[: system.contact_names.index(contact)])


def _gain(system: ConstrainedSystem, at: States, friction: Sequence[CoulombFriction]) -> Tensor | None:
    """U (I + LᵀU)⁻¹ `(n, nq, m)`, from the multiplier without friction to the friction; `None` for none."""
    present = {f.contact: f for f in friction if f.contact in system.contact_names}
    if not present:
        return None
    # U = (μ u of each contact, 0 without friction)
    columns = []
    for contact in system.contacts:
        law = present.get(contact.name)
        if law is None:
            columns.append(at.q.new_zeros(*at.q.shape, contact.rows))
        else:
            columns.append((law.coefficient * against_sliding(at, contact.name, law.smoothing))[..., None])
    # G (I + LᵀU) = U
    U = torch.cat(columns, dim=-1)
    eye = torch.eye(U.shape[-1], dtype=U.dtype, device=U.device)
    return torch.linalg.solve(eye + at.eom.L.mT @ U, U, left=False)
