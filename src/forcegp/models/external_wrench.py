"""Estimation of external wrenches from a log with a fitted model, and detection of contact."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import scipy.special
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem, Equations, SurfaceContact
from forcegp.constraints.gauss import tangent_frame
from forcegp.data import Dataset
from forcegp.errors import DataError, ModelError, ParameterError, check_name
from forcegp.forces.external_wrench import (
    FORCE_STD,
    MULTIPLIER_STD,
    MomentumLog,
    WrenchFrame,
    least_squares,
    momentum_force,
    observe,
    over_levers,
)
from forcegp.forces.noise import external_std, white_noise_std
from forcegp.forces.posterior import ForcePosterior, unknown_variance
from forcegp.forces.priors.memory import bristles
from forcegp.forces.problem import Problem
from forcegp.forces.quantities import AffineMap, States, affine_map, states_at
from forcegp.forces.unknowns import AXES, share_at_rest, tip_factor, tip_keys, tip_variance
from forcegp.models.prediction import CHUNK, Prediction

METHODS = ("acceleration", "momentum")
LEAST_VARIANCE = 1e-12
"""Least variance of the friction of a contact, which exceeds rounding errors [N²]."""
LEAST_NOISE = 1e-9
"""Minimum velocity noise, which exceeds rounding errors [rad/s, m/s]."""
THRESHOLD = 5.0
"""Number of standard deviations beyond which a contact is detected."""
BLOCK, LEAST_BLOCKS = 0.5, 20
"""Length of blocks with independent maxima of d² [s]; minimum number of blocks for estimating a tail."""


@dataclass(frozen=True, repr=False)
class ExternalWrench(Prediction):
    """Estimated external wrench at each sample of a log.

    Its `mean` has shape `(n, k)`, and its `covariance` has shape `(n, k, k)`. The covariance includes the
    uncertainty of the learned forces, the noise of torques and motion, and the prior on the wrench. In
    directions that have no effect on the joints, the covariance equals the prior covariance.

    Attributes:
        frame: the frame, and the estimated components of the wrench.
    """

    frame: WrenchFrame | None = None

    def detect(self, threshold: float = THRESHOLD, hold: int = 1, limit: float = 0.0) -> Tensor:
        """Return whether a wrench acts at each sample, as a mask `(n,)`.

        Without a wrench, d² = ŵᵀ C⁻¹ ŵ is at most a χ² variable with k degrees of freedom. A contact is
        detected if, in `hold` consecutive samples, d² exceeds both `limit` and a quantile of this
        distribution. The quantile has the tail probability of a Gaussian beyond ± `threshold` σ.

        Args:
            threshold: threshold [σ]. The probability of a false alarm is `false_alarm_rate(threshold)`.
            hold: number of consecutive samples, including the current sample.
            limit: lower limit for d², such as that of `exceeded_once_in`.

        Raises:
            ParameterError: the threshold is not positive, or `hold` is below one.
        """
        if not threshold > 0.0 or hold < 1:
            raise ParameterError(
                "invalid detection", expected="threshold > 0 [σ] and hold ≥ 1", got=(threshold, hold)
            )
        quantile = float(scipy.special.chdtri(self.mean.shape[-1], false_alarm_rate(threshold)))
        far = self.distance_squared > max(quantile, limit)
        held = far.clone()
        for lag in range(1, hold):
            held[lag:] &= far[:-lag]
            held[:lag] = False
        return held

    def exceeded_once_in(self, seconds: float, t: Tensor) -> float:
        """Return the value that d² exceeds about once in a given time of free motion.

        Call this method on an estimate from a log of free motion, such as the training log. Friction errors
        persist and have heavier tails than a Gaussian. The maxima of d² over blocks of `BLOCK` seconds are
        therefore treated as independent. Above their median u, P(d² > u + x) = ½ exp(−x/β).

        Args:
            seconds: duration of free motion in which one false alarm is expected [s].
            t: time of each sample `(n,)` [s], increasing within each trajectory.

        Example:
            `wrench.detect(limit=fit.external_wrench(train, "tool").exceeded_once_in(600.0, train.t))`

        Raises:
            DataError: the log has fewer than `LEAST_BLOCKS` blocks.
        """
        numbers = torch.div(t, BLOCK, rounding_mode="floor").unique_consecutive(return_inverse=True)[1]
        largest = t.new_zeros(int(numbers[-1]) + 1).scatter_reduce(0, numbers, self.distance_squared, "amax")
        if len(largest) < LEAST_BLOCKS:
            raise DataError(
                "the free motion is too short to predict the false alarm rate",
                expected=f"at least {LEAST_BLOCKS * BLOCK:g} s",
                got=f"{len(largest) * BLOCK:g} s",
            )
        median = largest.median()
        excess = float((largest[largest > median] - median).mean())
        return float(median) + excess * math.log(max(0.5 * seconds / BLOCK, 1.0))

    @property
    def distance_squared(self) -> Tensor:
        """Squared Mahalanobis distance from zero, d² = ŵᵀ C⁻¹ ŵ, `(n,)`."""
        assert self.covariance is not None
        scale = self.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        correlation = self.covariance / (scale[..., :, None] * scale[..., None, :])
        z = self.mean / scale
        return (z * torch.linalg.solve(correlation, z[..., None])[..., 0]).sum(-1)


def false_alarm_rate(threshold: float) -> float:
    """Return the probability that a Gaussian deviates by more than `threshold` standard deviations.

    Example:
        >>> round(false_alarm_rate(2.0), 4)
        0.0455
    """
    return math.erfc(threshold / math.sqrt(2.0))


@runtime_checkable
class LearnedForces(Protocol):
    """The learned forces of a fit, with their posterior, the noise and the robot."""

    @property
    def system(self) -> ConstrainedSystem: ...
    @property
    def posterior(self) -> ForcePosterior: ...
    @property
    def hyperparameters(self) -> Mapping[str, Tensor]: ...
    @property
    def noise(self) -> Mapping[str, Tensor]: ...
    @property
    def torque_std(self) -> Tensor | None: ...
    @property
    def problem(self) -> Problem: ...
    def beyond(self, qd: Tensor, tau: Tensor) -> Tensor | None: ...


@torch.no_grad()
def external_wrench(
    fit: LearnedForces,
    data: Dataset,
    frame: WrenchFrame,
    method: str,
    external: Mapping[str, float] | None = None,
) -> ExternalWrench:
    """Return the external wrench at each sample of a log, as in `StructuredFit.external_wrench`."""
    check_name("method of estimating a wrench", method, METHODS)
    reading = Reading.of(fit, data, frame, external)
    if method == "acceleration":
        mean, covariance = reading.from_accelerations()
    else:
        mean, covariance = reading.from_momenta()
    k = len(frame.axes)
    pairs = zip(mean.split(CHUNK), covariance.split(CHUNK), strict=True)
    prior, levers = frame.prior.to(mean), [lever.to(mean) for lever in frame.levers]
    parts = (over_levers(m, C, prior, levers) for m, C in pairs)
    mean, covariance = map(torch.cat, zip(*parts, strict=True))
    return ExternalWrench(
        mean,
        covariance,
        {"external_wrench": slice(0, k)},
        fit.beyond(data.qd, data.tau),
        fit.system.robot.joint_names,
        frame,
    )


@torch.no_grad()
def contact_force(
    fit: LearnedForces, data: Dataset, contact: str | None, prior_std: tuple[float, float] | None
) -> Prediction:
    """Return the forces of contacts at each sample of a log, as in `StructuredFit.contact_force`."""
    names = surface_contacts(fit.system, contact)
    mean, covariance = Reading.of(fit, data, ContactUnknown(names, prior_std), None).from_accelerations()
    read = names if contact is None else names[:1]
    closed = data.active(read).repeat_interleave(AXES, dim=-1)
    mean, covariance = mean[:, : closed.shape[-1]], covariance[:, : closed.shape[-1], : closed.shape[-1]]
    mean, covariance = mean * closed, covariance * closed[:, None] * closed[..., None]
    far, joints = fit.beyond(data.qd, data.tau), fit.system.robot.joint_names
    return Prediction(mean, covariance, parts_of_contacts(read), far, joints)


def parts_of_contacts(names: Sequence[str]) -> dict[str, slice]:
    """Return the slice of each contact in an array of their forces, or of the force of a single contact."""
    if len(names) == 1:
        return {"contact_force": slice(0, AXES)}
    return {name: slice(AXES * k, AXES * (k + 1)) for k, name in enumerate(names)}


def surface_contacts(system: ConstrainedSystem, first: str | None) -> tuple[str, ...]:
    """Return the names of all surface contacts, beginning with the given one.

    Raises:
        UnknownNameError: the contact does not exist.
        ModelError: the contact has no surface, or no contact has one.
    """
    if first is not None and not isinstance(contact := system.contact(first), SurfaceContact):
        text = f"contact {first!r} has no surface"
        raise ModelError(text, expected="a SurfaceContact", got=type(contact).__name__)
    names = [each.name for each in system.contacts if isinstance(each, SurfaceContact)]
    if not names:
        text = "the system has no contact with a surface"
        raise ModelError(text, expected="a SurfaceContact", got=", ".join(system.contact_names) or "none")
    return tuple(sorted(names, key=lambda name: name != first))


class Unknown(NamedTuple):
    """An unknown force F = m + D w of each row with w ~ N(0, diag prior²), which acts on the joints as Jᵀ F.

    Attributes:
        J: `(n, k, nq)` Jacobian.
        prior: `(u,)` standard deviations of w.
        offset: m `(n, k)`, or `None` for zero.
        directions: D `(n, k, u)`, or `None` for w = F.
    """

    J: Tensor
    prior: Tensor
    offset: Tensor | None = None
    directions: Tensor | None = None

    def force(self, w: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean `(n, k)` and covariance `(n, k, k)` of F from those of w."""
        if self.offset is None or self.directions is None:
            return w, covariance
        D = self.directions
        return self.offset + (D @ w[..., None])[..., 0], D @ covariance @ D.mT


@dataclass(frozen=True)
class ContactUnknown:
    """Forces at closed surface contacts, F = λ (n − μ s(v)) + F_z + u (`StructuredFit.contact_force`).

    All contacts of a system are unknown, as λ of one depends on the others.

    Attributes:
        contacts: names of the contacts.
        prior_std: prior standard deviations of λ and u [N], or `None` for a free λ and the learned size of u.
    """

    contacts: tuple[str, ...]
    prior_std: tuple[float, float] | None = None

    def separated(self, posterior: ForcePosterior) -> ForcePosterior:
        """Return the posterior without Coulomb friction at these contacts, which is proportional to λ."""
        coulomb = tuple(law for law in posterior.process.coulomb if law.contact not in self.contacts)
        return dataclasses.replace(posterior, process=dataclasses.replace(posterior.process, coulomb=coulomb))

    def unknown(
        self, fit: LearnedForces, at: States, friction: Callable[[str, Tensor], tuple[Tensor, Tensor]]
    ) -> Unknown:
        """Return the unknown forces `(n, 3 c)`, given the mean and covariance of B J_EᵀF_z as a function."""
        each = [self._at(name, fit, at, friction) for name in self.contacts]
        J, prior, offset, directions = zip(*each, strict=True)
        blocks = [torch.block_diag(*row) for row in zip(*(D.unbind() for D in directions), strict=True)]
        return Unknown(torch.cat(J, dim=-2), torch.cat(prior), torch.cat(offset, dim=-1), torch.stack(blocks))

    def _at(
        self,
        name: str,
        fit: LearnedForces,
        at: States,
        friction: Callable[[str, Tensor], tuple[Tensor, Tensor]],
    ) -> Unknown:
        point, closed = at.eom.contact_points[name], at.active[:, fit.system.contact_names.index(name)]
        n, v, t = point.unit_normal, point.sliding[1], tangent_frame(point.unit_normal)
        normal, s = self.prior_std or (MULTIPLIER_STD, FORCE_STD)
        if self.prior_std is None and tip_keys(name).rests in fit.hyperparameters:
            variance = tip_variance(fit.hyperparameters, at, name)
        else:
            variance = s**2 * share_at_rest(fit.hyperparameters, at, name)
        # F_z + u in the tangent frame, with the covariance R Rᵀ
        to_tangent = torch.linalg.pinv((t.mT @ point.jacobian).mT)
        mean, C = friction(name, to_tangent)
        C = C + torch.diag_embed(variance[:, None].expand(-1, 2))
        # The covariance of F_z is a difference, which rounding may make indefinite.
        sizes, axes = torch.linalg.eigh(0.5 * (C + C.mT))
        R = axes * sizes.clamp(min=LEAST_VARIANCE).sqrt()[..., None, :]
        # n − μ s(v)
        direction = n
        for law in fit.posterior.process.coulomb:
            if law.contact == name:
                size = (v.square().sum(-1, keepdim=True) + law.smoothing**2).sqrt()
                direction = direction - law.coefficient * v / size
        offset = (t @ mean[..., None])[..., 0]
        directions = torch.cat([direction[..., None], t @ R], dim=-1)
        return Unknown(
            closed[:, None, None] * point.jacobian, n.new_tensor([normal, 1.0, 1.0]), offset, directions
        )


class JointForces(NamedTuple):
    """Forces at n states: mean of Q̄ `(n, nq)`, which includes that of the unknown force, its covariance with
    torque noise `(n, nq, nq)`, the equations of motion, J for w and multipliers `(n, u, nq)`, their prior
    standard deviations `(u,)`, and the unknown force."""

    mean: Tensor
    covariance: Tensor
    eom: Equations
    J: Tensor
    prior: Tensor
    unknown: Unknown


@dataclass(frozen=True)
class Reading:
    """A log prepared for wrench estimation.

    Attributes:
        fit, data: the learned forces and the log.
        source: the frame with the components to estimate, or the contact.
        history: states of bristles along the log if a force depends on the past, otherwise `None`.
        external: standard deviation of other unknown joint forces `(nq,)`, or `None`.
    """

    fit: LearnedForces
    data: Dataset
    source: WrenchFrame | ContactUnknown
    history: Tensor | None
    external: Tensor | None = None

    @classmethod
    def of(
        cls,
        fit: LearnedForces,
        data: Dataset,
        source: WrenchFrame | ContactUnknown,
        external: Mapping[str, float] | None,
    ) -> Reading:
        """Prepare a log. Friction with memory follows from the velocities of a log in time order."""
        history, remembers = None, any(prior.remembers for prior in fit.posterior.priors)
        if remembers and data.header.ordered:
            history = bristles(data.t, fit.system.robot.drive_motion(data.qd), data.segment)
        return cls(fit, data, source, history, external_std(external, fit.system.robot))

    def forces(self, rows: Tensor, qdd: Tensor) -> JointForces:
        """Return the forces at the given rows, including inertia errors at accelerations qdd `(n, nq)`."""
        data, fit, system = self.data[rows], self.fit, self.fit.system
        active = data.active(system.contact_names)
        at, _ = states_at(system, data.q, data.qd, data.tau, active)
        history = None if self.history is None else self.history[rows]
        at = dataclasses.replace(at, qdd=qdd, history=history, recording=data.recording[:, None])
        mean, S, force, A = self._learned(at)
        unknown = unknown_variance(fit.hyperparameters, at, fit.problem.external_std)
        stated = data.extras.get("tau_std")
        for std in (self.external, stated, fit.torque_std):
            unknown = unknown if std is None else unknown + std**2
        S = S + torch.diag_embed(unknown)
        # Multipliers of closed contacts are additional unknowns; the rows of open contacts are zero.
        prior = torch.cat([force.prior, data.q.new_full((A.shape[-2],), MULTIPLIER_STD)])
        J = force.J if force.directions is None else force.directions.mT @ force.J
        return JointForces(mean, S, at.eom, torch.cat([J, A], dim=-2), prior, force)

    def _learned(self, at: States) -> tuple[Tensor, Tensor, Unknown, Tensor]:
        """Return the mean and covariance of learned forces, the unknown force, and A of other contacts."""
        system, posterior = self.fit.system, self.fit.posterior
        z, A = affine_map(system, at, "total_force"), at.eom.A
        values = self.fit.hyperparameters
        if isinstance(self.source, WrenchFrame):
            J = self.source.jacobian(system.robot, at.q)
            mean, S = posterior.read(system, at, z)
            S = S + _of_tips(posterior, values, system, at, z)
            return mean, S, Unknown(J, self.source.prior.to(at.q)), A
        names, posterior = self.source.contacts, self.source.separated(posterior)
        values = {key: x for key, x in values.items() if not any(key in tip_keys(name) for name in names)}
        owners = [getattr(prior, "contact", None) for prior in posterior.priors]
        rows = posterior.rows(system, at, z)

        def part(includes: Callable[[str | None], bool], B: Tensor) -> tuple[Tensor, Tensor]:
            pairs = zip(owners, rows.operators, strict=True)
            chosen = tuple(B @ (W if includes(owner) else torch.zeros_like(W)) for owner, W in pairs)
            block = dataclasses.replace(rows, operators=chosen, target=(B @ rows.target[..., None])[..., 0])
            return posterior.latent.mean(block), posterior.latent.covariance(block)

        force = self.source.unknown(self.fit, at, lambda name, B: part(lambda owner: owner == name, B))
        mean, S = part(lambda owner: owner not in names, torch.eye(at.q.shape[-1]).to(at.q))
        mean = mean + rows.target
        if force.offset is not None:
            mean = mean + (force.J.mT @ force.offset[..., None])[..., 0]
        others = torch.ones(A.shape[-2], dtype=torch.bool)
        for name in names:
            others[system.rows[name]] = False
        S = S + _of_tips(posterior, values, system, at, z)
        return mean, S, force, A[:, others.to(A.device)]

    def from_accelerations(self) -> tuple[Tensor, Tensor]:
        """Estimate the mean and covariance for each sample by generalized least squares."""
        stated, parts = self.data.extras.get("qdd_std"), []
        learned = self.fit.noise.get("qdd", self.data.q.new_zeros(self.data.nq))
        for rows in torch.arange(len(self.data)).split(CHUNK):
            qdd = self.data.qdd[rows]
            forces = self.forces(rows, qdd)
            M, std = forces.eom.M, learned.expand_as(qdd) if stated is None else stated[rows]
            S = forces.covariance + M @ torch.diag_embed(std**2) @ M.mT
            r = (M @ qdd[..., None])[..., 0] - forces.mean
            w, covariance = least_squares(forces.J, r, S, forces.prior)
            u = len(forces.unknown.prior)
            parts.append(forces.unknown.force(w[:, :u], covariance[:, :u, :u]))
        mean, covariance = zip(*parts, strict=True)
        return torch.cat(mean), torch.cat(covariance)

    def from_momenta(self) -> tuple[Tensor, Tensor]:
        """Estimate the mean and covariance along each trajectory with the momentum filter."""
        if not self.data.header.ordered:
            raise DataError("the momentum filter needs a log in time order", got="points in another order")
        correlation = self.fit.problem.correlation
        if self.fit.torque_std is None or correlation is None:
            raise ModelError(
                "this fit has no learned torque noise, which the momentum filter needs",
                hint="fit more samples in time order, with the default priors",
            )
        assert isinstance(self.source, WrenchFrame)
        noise, segment = velocity_noise(self.data), self.data.segment
        trajectories = ((segment == k).nonzero()[:, 0] for k in segment.unique_consecutive())
        logs = (self.momenta(rows, noise, correlation) for rows in trajectories)
        mean, covariance = zip(*map(observe, logs), strict=True)
        mean, covariance = (torch.from_numpy(np.concatenate(x)).to(self.data.q) for x in (mean, covariance))
        k = len(self.source.axes)
        return mean[:, :k], covariance[:, :k, :k]

    def momenta(self, trajectory: Tensor, noise: Tensor, correlation: Tensor) -> MomentumLog:
        """Return the inputs to the momentum filter for the rows of one trajectory."""
        assert isinstance(self.source, WrenchFrame)
        robot, columns, prior = self.fit.system.robot, [], self.source.prior
        for rows in trajectory.split(CHUNK):
            q, qd = self.data.q[rows], self.data.qd[rows]
            # Without accelerations, only the gravity forces due to inertia errors are included.
            forces = self.forces(rows, torch.zeros_like(q))
            prior = forces.prior
            M, added = momentum_force(robot, q, qd)
            p = (M @ qd[..., None])[..., 0]
            p_noise = M @ torch.diag(noise**2) @ M.mT
            factor = torch.linalg.cholesky(forces.covariance)
            columns.append((p, p_noise, forces.mean - forces.eom.Q_C + added, forces.J, factor))
        p, p_noise, u, J, factor = (torch.cat(parts).cpu().numpy() for parts in zip(*columns, strict=True))
        t, open_ = self.data.t[trajectory].cpu().numpy(), prior[len(self.source.axes) :]
        change = torch.cat([self.source.changes.to(open_), open_])
        known = [x.cpu().numpy() for x in (prior, change, correlation)]
        return MomentumLog(t, p, p_noise, u, J, known[0], known[1], factor, known[2])


def _of_tips(
    posterior: ForcePosterior,
    values: Mapping[str, Tensor],
    system: ConstrainedSystem,
    at: States,
    z: AffineMap,
) -> Tensor:
    """Return the covariance of z due to unknown tangential forces at contacts `(n, d, d)`."""
    tips = tip_factor(values, system, at)
    if tips is None:
        return torch.zeros_like(at.eom.M)
    W = posterior.process.coupled(system, at, z).B_z @ tips
    return W @ W.mT


def velocity_noise(data: Dataset) -> Tensor:
    """Return the standard deviation `(nq,)` of white velocity noise in an evenly sampled log.

    Raises:
        DataError: no trajectory has five consecutive samples.
    """
    whole = data.segment[4:] == data.segment[:-4]
    if not bool(whole.any()):
        raise DataError("velocity noise cannot be estimated", expected="five samples of one trajectory")
    return white_noise_std(data.qd, whole).clamp(min=LEAST_NOISE)
