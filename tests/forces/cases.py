"""A robot in two contacts, open and closed sample by sample, with every quantity logged."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

import forcegp
from forcegp.constraints import ConstrainedSystem
from forcegp.data.fields import DataHeader
from forcegp.forces.posterior import ForceSamples
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.contact import (
    ContactForcePrior,
    NormalForcePrior,
    SlidingFrictionPrior,
    with_coulomb,
)
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.forces.priors.sets import REMAINING, friction_priors
from forcegp.forces.quantities import States
from forcegp.gp.kernels import Linear, SquaredExponential
from forcegp.models.structured_fit import StructuredFit

CONTACTS = ("table", "ball")
NOISE = 0.1


@cache
def two_contacts(stabilized: bool = True) -> forcegp.ConstrainedSystem:
    """The KUKA arm with its tip on an inclined table and its elbow on a ball."""
    robot = forcegp.load_robot("kuka_iiwa", base_position=(0.1, 0.2, 0.05))
    table = forcegp.SurfaceContact("table", "lbr_iiwa_link_7", (0, 0, 0.1), forcegp.Plane((0, 0.2, 1), 0.055))
    ball = forcegp.SurfaceContact(
        "ball", "lbr_iiwa_link_5", (0.1, 0, 0.1), forcegp.constraints.Sphere((1, 1, 1), 0.3)
    )
    return forcegp.ConstrainedSystem(
        robot, [table, ball], forcegp.constraints.Baumgarte() if stabilized else None
    )


def draw(n: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """States (q, q̇, τ)."""
    generator = torch.Generator().manual_seed(seed)
    q, qd, tau = (torch.randn(n, 7, generator=generator, dtype=torch.float64) for _ in range(3))
    return q, 0.3 * qd, 20.0 * tau


def mixed_contacts(n: int) -> Tensor:
    """Both contacts, the first, the second, none, and again, `(n, 2)`."""
    return torch.stack([torch.arange(n) % 4 < 2, torch.arange(n) % 2 == 0], dim=-1)


def logged(
    system: forcegp.ConstrainedSystem, n: int, seed: int = 0, active: Tensor | None = None
) -> forcegp.Dataset:
    """Unknown joint force and friction; accelerations that obey the constraint, but for the noise."""
    q, qd, tau = draw(n, seed)
    active = mixed_contacts(n) if active is None else active
    generator = torch.Generator().manual_seed(seed + 1)
    eom = system.equations(q, qd, active)
    Q = eom.Q_K + tau + 2.0 * torch.sin(q) - 3.0 * qd
    Q_z = torch.zeros_like(Q)
    for i, name in enumerate(CONTACTS):
        point = eom.contact_points[name]
        slip = point.velocity - point.normal * (point.normal * point.velocity).sum(-1, keepdim=True)
        Q_z = Q_z - active[:, i, None] * (point.jacobian.mT @ slip[..., None])[..., 0]
    multiplier = eom.multiplier(Q + Q_z)
    noise = NOISE * torch.randn(n, 7, generator=generator, dtype=torch.float64)
    normals = {name: eom.contact_points[name].normal for name in CONTACTS}
    return forcegp.Dataset(
        t=torch.arange(n, dtype=torch.float64) * 0.1,
        q=q,
        qd=qd,
        tau=tau,
        qdd=eom.acceleration(Q + Q_z) + noise,
        joint_names=system.robot.joint_names,
        header=DataHeader(seed=seed),
        contact={name: active[:, i] for i, name in enumerate(CONTACTS)},
        extras={"Q": Q, "Q_z": Q_z, "Q_I": eom.constraint_force(Q + Q_z)},
        contact_extras={
            "multiplier": {name: multiplier[:, i] for i, name in enumerate(CONTACTS)},
            "F_I": {name: normals[name] * multiplier[:, i, None] for i, name in enumerate(CONTACTS)},
        },
    )


def all_priors() -> list[ForcePrior]:
    return [
        JointForcePrior(REMAINING),
        ContactForcePrior("table", Linear(("velocity",)) + SquaredExponential()),
        SlidingFrictionPrior("ball"),
    ]


def friction_and_residual() -> list[ForcePrior]:
    """Friction, and a joint force without a law, in two contacts."""
    residual = JointForcePrior(SquaredExponential(("q", "qd"), shared=True), inputs=("q", "qd"))
    return [*friction_priors(two_contacts()), residual, NormalForcePrior(residual)]


def conditioned(
    observations: forcegp.Dataset | list[forcegp.priors.Observation], seed: int = 0, **settings: object
) -> StructuredFit:
    """A fit with hyperparameters drawn at random around the start, conditioned, nothing learned."""
    settings = {"mean": "analytical", "force_priors": all_priors(), **settings}
    model = forcegp.StructuredGP(two_contacts(), **settings)  # type: ignore[arg-type]
    fit = model.fit(observations, learn=["noise"], options=forcegp.models.LearningOptions(max_evaluations=1))
    generator = torch.Generator().manual_seed(seed)
    values = {}
    for key, value in fit.hyperparameters.items():
        step = 0.4 * torch.randn(value.shape, generator=generator, dtype=torch.float64)
        values[key] = value.clamp(min=-3.0) + step if "noise" not in key else value
    return fit.condition(observations, values)


def sampled_forces(samples: ForceSamples, system: ConstrainedSystem, at: States) -> tuple[Tensor, Tensor]:
    """Joint force Q and dissipative contact force Q_z of all samples at all states, `(samples, n, nq)`."""
    # Q = m + Σ E f over joint forces, Q_z = Σ E f over contact forces (eq. 18)
    process = samples.posterior.process
    Q = process.mean(system, at).expand(samples.count, *at.q.shape)
    Q_z = torch.zeros_like(Q)
    for p, prior in enumerate(process.priors):
        features = process.features(p, system, at)
        latent = samples.functions.latent(p, features)
        force = (prior.operator(system, at) @ latent[..., None])[..., 0]
        Q, Q_z = (Q, Q_z + force) if prior.target == "contact" else (Q + force, Q_z)
    # Q_z ← Q̄ − Q, with Coulomb friction in Q̄
    return Q, with_coulomb(system, at, Q + Q_z, process.coulomb) - Q
