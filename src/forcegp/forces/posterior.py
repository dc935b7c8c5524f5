"""Prior and posterior (eq. 22) of the impressed forces, and functions drawn from the posterior.

Q̄ = m + Σ_p E_p f_p with f_p ~ GP(0, k_p), plus contact friction proportional to the multiplier. Every
quantity z = B_Q Q + B_z Q_z + o is an affine map of the latent forces f_p, so its posterior follows from
theirs. Each function drawn from the posterior is a deterministic force field that can be integrated.

Accelerations in contact depend only on Q + Q_z (remark 3.3). The two are distinguished by their directions
(Q_z acts only in contact, and tangentially), by their inputs, and by measurements of either force. Their
posterior correlation is −1 if only the sum is identifiable, and 0 if both are.

**Forces that are not functions of the state.** At rest, joint friction balances the other forces. An
additional unknown force with variance σ_s² e^{−(q̇/v_s)²} therefore acts on joints that barely move. Beyond
the trained range of speeds and torques, joint forces have an additional standard deviation g D, where D is
the distance from that range in training standard deviations, and g is estimated by `held_out.growth`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.linalg import vecdot

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.measurements import Training
from forcegp.forces.priors.base import CONSTRAINT, CONTACT, JOINT, NOISE, ForceMean, ForcePrior
from forcegp.forces.priors.contact import CoulombFriction, coupled, with_coulomb
from forcegp.forces.quantities import DOUBTS, AffineMap, States, affine_map, hidden_forces
from forcegp.forces.term import JointTerm
from forcegp.gp.draws import FunctionSamples
from forcegp.gp.exact import ExactPosterior
from forcegp.gp.features import Block, Standardization
from forcegp.gp.sparse import SparsePosterior

STICK_NOISE, STICK_SPEED = f"{NOISE}.stick.log_noise_std", f"{NOISE}.stick.log_speed"
"""Names of the learned parameters σ_s and v_s of each joint."""
MEMORY = f"{NOISE}.memory.log_std"
"""Name of the standard deviation `(nq,)` of friction with memory at a state without past [N m, N]."""
REGION = f"{NOISE}.region."
LOW, HIGH, SPREAD, GROWTH = (REGION + name for name in ("low", "high", "spread", "growth"))
"""Names under which the trained region is stored: the lower limits, upper limits and standard deviations of
the speed and torque of each joint, each `(2, nq)`, and g `(nq,)` [N m, N]."""
OUTERMOST, WIDEST = 0.01, 0.16
"""Smallest and largest fraction of the training samples beyond each limit of the region. The largest is the
tail of a Gaussian beyond one standard deviation. At least one independent sample lies beyond.
"""
SLOWEST = 1e-3
"""Least standard deviation of a joint's speed [rad/s, m/s], below the noise of computed velocities. ±2σ holds
for .17 to 1.00 of the torques of five joints that stood still in training (three simulated logs,
`benchmarks/unusual_logs.py`), and with 0.02 for .01 to .31."""
UNLOADED = 1e-6
"""Least load of a joint, relative to the largest: a free base may have neither torque nor load."""
RELATIVE = 0.05
"""Prior ratio of the growth rate g to the typical load of a joint; torque constants and load-dependent
friction are uncertain by about 5 %. If it were the rate, errors of an external force on a simulated UR5 would
be .68 instead of .56 N, as its torques lie beyond those of training. With rate zero, ±2σ holds for 78 %
instead of 98 % of the vertical force on a leg (`benchmarks/real_contact.py --default`)."""
FAR_BEYOND = 3.0
"""Distance beyond the trained region above which predictions issue a warning."""


@dataclass(frozen=True, eq=False)
class ForceProcess:
    """Force priors and the learned parameters of their operators.

    Attributes:
        priors, scales: force priors, and the standardization of their inputs.
        mean: prior mean of Q.
        coulomb: contact friction proportional to the multiplier.
    """

    priors: tuple[ForcePrior, ...]
    scales: tuple[Standardization, ...]
    mean: ForceMean
    coulomb: tuple[CoulombFriction, ...] = ()

    def features(self, p: int, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        """Return the standardized kernel inputs of prior p at given states."""
        return self.scales[p].apply(self.priors[p].features(system, at))

    def coupled(self, system: ConstrainedSystem, at: States, z: AffineMap) -> AffineMap:
        """Add Coulomb friction at the contacts to the affine map of a quantity."""
        return coupled(system, at, z, self.coulomb)

    def rows(self, system: ConstrainedSystem, at: States, z: AffineMap, errors: bool = True) -> Block:
        """Express a quantity as rows that act on the latent forces.

        Args:
            z: the quantity, including Coulomb friction at the contacts.
            errors: whether the operators of errors are needed, which are zero otherwise.

        Returns:
            Kernel inputs and operators B(x) E(x) of each prior, with the target o(x) + B(x) m(x).
        """
        # E[z] = o + B_Q m (eq. 15)
        target = z.o + vecdot(z.B_Q, self.mean(system, at)[..., None, :])
        by_target = {CONTACT: z.B_z, CONSTRAINT: z.B_N}
        features, operators = [], []
        for p, prior in enumerate(self.priors):
            # W = B E (eq. 12), where E is the identity for a prior per joint
            features.append(self.features(p, system, at))
            B = by_target.get(prior.target, z.B_Q)
            if B is not None and z.B_F is not None and isinstance(prior, JointTerm):
                B = B + z.B_F
            if B is None or (prior.is_error and not errors):
                operators.append(z.o.new_zeros(*z.o.shape, prior.outputs(system.robot)))
            else:
                operators.append(prior.applied(B, system, at))
        return Block(tuple(features), tuple(operators), target)


LatentPosterior = ExactPosterior | SparsePosterior
"""Latent processes conditioned on rows, exactly or with inducing points."""


@dataclass(frozen=True, eq=False)
class ForcePosterior:
    """Latent forces conditioned on data. They do not depend on the constraint used for prediction.

    Attributes:
        process: prior on the forces.
        latent: the conditioned latent processes.
    """

    process: ForceProcess
    latent: LatentPosterior

    @property
    def priors(self) -> tuple[ForcePrior, ...]:
        """The force priors."""
        return self.process.priors

    def __call__(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Return the posterior mean `(n, nq)` of Q̄ = Σ E f + m, which is the force field for rollouts."""
        force = self.unknown_force(system, at, range(len(self.priors))) + self.process.mean(system, at)
        return with_coulomb(system, at, force, self.process.coulomb)

    def unknown_force(self, system: ConstrainedSystem, at: States, priors: Iterable[int]) -> Tensor | float:
        """Return the posterior mean `(n, nq)` of Σ E f over the given priors, excluding Coulomb friction."""
        # Σ_p E_p μ_p
        force: Tensor | float = 0.0
        for p in (p for p in priors if self.latent.measured[p] and not self.priors[p].is_error):
            mean = self.latent.latent_mean(p, self.process.features(p, system, at))
            force = force + (self.priors[p].operator(system, at) @ mean[..., None])[..., 0]
        return force

    def rows(self, system: ConstrainedSystem, at: States, z: AffineMap) -> Block:
        """Express a quantity at n states as rows that act on the processes. The target is its prior mean.

        Args:
            z: the quantity, excluding Coulomb friction at the contacts.
        """
        # W = B E, target o + B m (eqs. 12 and 15)
        return self.process.rows(system, at, self.process.coupled(system, at, z))

    def read(self, system: ConstrainedSystem, at: States, z: AffineMap) -> tuple[Tensor, Tensor]:
        """Return the posterior mean `(n, d)` and covariance `(n, d, d)` of a quantity, excluding noise.

        For the multiplier, the mean is that of eq. 25, with −Lᵀ for L.
        """
        # o + B (m + Σ E μ), and W Cov(f) Wᵀ (eqs. 23 and 24)
        rows = self.rows(system, at, z)
        return rows.target + self.latent.mean(rows), self.latent.covariance(rows)

    def read_mean(self, system: ConstrainedSystem, at: States, z: AffineMap) -> Tensor:
        """Return the posterior mean o + B (m + Σ E μ) `(n, d)` of a quantity at the given states."""
        rows = self.process.rows(system, at, self.process.coupled(system, at, z), errors=False)
        return rows.target + self.latent.mean(rows)


def stick_variance(tensors: Mapping[str, Tensor], at: States) -> Tensor:
    """Return the variance of static joint friction, `(n, nq)`, which is zero unless it is learned."""
    if STICK_NOISE not in tensors:
        return torch.zeros_like(at.q)
    std, speed = tensors[STICK_NOISE].exp(), tensors[STICK_SPEED].exp()
    return std**2 * torch.exp(-((at.qd / speed) ** 2))


def trained_region(qd: Tensor, tau: Tensor, load: Tensor, independent: float = math.inf) -> dict[str, Tensor]:
    """Return the region of the training samples `(n, nq)` as entries named `LOW`, `HIGH` and `SPREAD`.

    Args:
        qd, tau: velocities and torques of the samples in motion.
        load: typical torque of each joint `(nq,)`. A fraction of it is the lower bound on the standard
            deviation of the torque.
        independent: number of independent samples, one of which lies beyond each limit.
    """
    x = torch.stack([qd, tau], dim=1)
    share = min(max(OUTERMOST, 1.0 / independent), WIDEST)
    low, high = x.quantile(torch.tensor([share, 1.0 - share]).to(x), dim=0)
    load = load.maximum(UNLOADED * load.max()).clamp(min=1e-12)
    least = torch.stack([torch.full_like(load, SLOWEST), RELATIVE * load])
    spread = x.std(0, correction=0).maximum(least)
    return {LOW: low, HIGH: high, SPREAD: spread}


def distance_beyond(tensors: Mapping[str, Tensor], qd: Tensor, tau: Tensor) -> Tensor:
    """Return the distance D `(*batch, nq)` from the trained region, in training standard deviations."""
    if LOW not in tensors:
        return torch.zeros_like(qd)
    x = torch.stack([qd, tau], dim=-2)
    beyond = (tensors[LOW] - x).maximum(x - tensors[HIGH]).clamp(min=0.0)
    return (beyond / tensors[SPREAD]).norm(dim=-2)


def warnings_beyond(distance: Tensor, joints: Sequence[str]) -> tuple[str, ...]:
    """Return a warning if states are far beyond the trained region.

    Args:
        distance: distance D `(*batch, nq)`.
    """
    rows = distance.reshape(-1, distance.shape[-1])
    far = int((rows > FAR_BEYOND).any(-1).sum())
    if not far:
        return ()
    most, joint = rows.amax(0).max(0)
    return (
        f"{far} of {len(rows)} states lie beyond the trained speeds and torques, by up to {float(most):.3g} "
        f"training deviations ({joints[int(joint)]}), so error bars are extrapolated: train on such motion",
    )


def hidden_variance(tensors: Mapping[str, Tensor], at: States, external: Tensor | None) -> Tensor:
    """Return the variance `(n, nq)` of static friction and of unknown forces with std `external` `(nq,)`."""
    variance = stick_variance(tensors, at)
    if MEMORY in tensors and at.history is None:
        variance = variance + (2.0 * tensors[MEMORY]).exp()
    return variance if external is None else variance + external**2


def unknown_variance(tensors: Mapping[str, Tensor], at: States, external: Tensor | None) -> Tensor:
    """Return the additional variance `(n, nq)` of predicted forces, which is `hidden_variance` plus g² D²."""
    variance = hidden_variance(tensors, at, external)
    if GROWTH not in tensors:
        return variance
    return variance + (tensors[GROWTH] * distance_beyond(tensors, at.qd, at.tau)).square()


CHUNK_STATES = 256
"""Number of states at which samples are evaluated at a time, so that arrays fit into the processor cache."""


@dataclass(frozen=True, eq=False)
class ForceSamples:
    """Forces drawn from the posterior.

    Attributes:
        posterior: the posterior that the samples are drawn from.
        functions: sampled latent functions.
    """

    posterior: ForcePosterior
    functions: FunctionSamples

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.functions.count

    def __call__(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Return Q̄ = Q + Q_z with one sample per trajectory, which is the force field for rollouts.

        Args:
            at: samples · k states, of which the s-th group of k states belongs to sample s.

        Returns:
            `(samples · k, nq)` [N m, N].
        """
        # Q̄ = m + Σ E f
        priors = range(len(self.posterior.priors))
        Q_bar = self.posterior.process.mean(system, at) + self.unknown_force(system, at, priors)
        return with_coulomb(system, at, Q_bar, self.posterior.process.coulomb)

    def unknown_force(self, system: ConstrainedSystem, at: States, priors: Iterable[int]) -> Tensor | float:
        """Return Σ E f over the given priors, excluding Coulomb friction at the contacts."""
        unknown: Tensor | float = 0.0
        runs = len(at.q) // self.count
        step = max(1, CHUNK_STATES // max(runs, 1))
        chunks = [range(i, min(i + step, self.count)) for i in range(0, self.count, step)]
        for p in priors:
            prior, features = self.posterior.priors[p], self.posterior.process.features(p, system, at)
            parts = []
            for chunk in chunks:
                piece = {n: x[chunk.start * runs : chunk.stop * runs] for n, x in features.items()}
                parts.append(self.functions.by_runs(p, piece, chunk, runs))
            unknown = unknown + (prior.operator(system, at) @ torch.cat(parts)[..., None])[..., 0]
        return unknown


def draw_samples(
    posterior: ForcePosterior, count: int, generator: torch.Generator, features: int | None = None
) -> ForceSamples:
    """Draw force functions from the posterior.

    Args:
        generator: source of randomness, on the CPU.
        features: number of random features per component; the default depends on the type of posterior.
    """
    size = () if features is None else (features,)
    return ForceSamples(posterior, posterior.latent.draw(count, generator, *size))


CORRELATION_STATES = 50
"""Number of training states at which a fit evaluates the correlation of Q and Q_z."""
QUESTIONABLE_DISTANCE = 0.02
"""Distance from the surface above which a closed contact is questionable [m]."""
UNDETERMINED = 10.0
"""Relative standard deviation of the multiplier above which a fit issues a warning."""
MISSED = 2.0
"""Root mean square residual, in units of the noise, above which a fit issues a warning."""
LARGE_JITTER = 0.01
"""Jitter, relative to unit noise, at which a fit issues a warning; it increases the noise by half as much."""


def force_correlation(posterior: ForcePosterior, system: ConstrainedSystem, at: States) -> Tensor:
    """Return the posterior correlation of Q and Q_z for each state and joint, `(n, nq)`.

    corr_i = Cov(Q_i, Q_z,i) / √(Var Q_i Var Q_z,i), excluding the part of Q along the constraint; 0 if either
    variance is zero.
    """
    z = affine_map(system, at, ("joint_force", "contact_friction"))
    rows = posterior.rows(system, at, z)
    hidden = [prior.target == CONSTRAINT for prior in posterior.priors]
    operators = (torch.zeros_like(W) if hide else W for hide, W in zip(hidden, rows.operators, strict=True))
    covariance = posterior.latent.covariance(dataclasses.replace(rows, operators=tuple(operators)))
    # Cov(Q_i, Q_z,i)/√(Var Q_i Var Q_z,i)
    nq = system.robot.nq
    cross = covariance[:, :nq, nq:].diagonal(dim1=-2, dim2=-1)
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    scale = (variance[:, :nq] * variance[:, nq:]).sqrt()
    return torch.where(scale > 0.0, cross / scale.where(scale > 0.0, 1.0), 0.0).clamp(-1.0, 1.0)


def doubts_of(
    posterior: ForcePosterior, system: ConstrainedSystem, training: Training, power: float
) -> tuple[float | None, tuple[str, ...]]:
    """Return warnings about a posterior at training states, for a likelihood with exponent `power`.

    Returns:
        The mean correlation of Q and Q_z over training states in contact (`None` unless both have priors),
        and the warnings, each with a suggested remedy.
    """
    few = training.evenly(min(CORRELATION_STATES, training.samples)).measurements if training.samples else ()
    # Elsewhere Q_z is zero, and there is no multiplier.
    closed = [m[m.active.any(-1).nonzero()[:, 0]] for m in few]
    targets = {prior.target for prior in posterior.priors}
    means, variances, correlations, warnings = [], [], [], ()
    for m in (m for m in closed if len(m.q)):
        at = m.at(system)
        off = at.eom.c.abs().where(at.eom.holds, 0.0).amax(0).tolist()
        names = [c.name for c in system.contacts for _ in range(c.rows)]
        warnings += tuple(
            f"contact {name} is closed up to {1e3 * c:.3g} mm off its surface: check surface, point and "
            "labels (`forcegp check`)"
            for name, c in zip(names, off, strict=True)
            if c > QUESTIONABLE_DISTANCE
        )
        mean, covariance = posterior.read(system, at, affine_map(system, at, "multiplier"))
        loaded, hidden = at.eom.holds, hidden_forces(system, at, {"multiplier": slice(0, system.m)})
        if hidden is not None:
            loaded, warnings = loaded & ~hidden.whole, (*warnings, *hidden.doubts)
        means.append(mean[loaded])
        variances.append(covariance.diagonal(dim1=-2, dim2=-1)[loaded])
        if {JOINT, CONTACT} <= targets:
            correlations.append(force_correlation(posterior, system, at))
    correlation = float(torch.cat(correlations).mean()) if correlations else None
    warnings = tuple(dict.fromkeys(warnings))
    if means and len(torch.cat(means)):
        warnings += _on_multiplier(torch.cat(means), torch.cat(variances))
    never = training.never_closed(system)
    warnings += (DOUBTS[0].format(", ".join(never)),) if never else ()
    residual = (posterior.latent.residual / power) ** 0.5
    if residual > MISSED:
        warnings += (
            f"the model fits its training data poorly: residuals are {residual:.3g} times the noise; check "
            "the log and the robot file (`forcegp check`), or allow other forces or larger noise",
        )
    jitter = posterior.latent.jitter
    if jitter >= LARGE_JITTER:
        warnings += (
            f"the covariance was factorised with a jitter of {jitter:.2g} times the noise variance: "
            "drop duplicated rows, or specify a larger noise",
        )
    return correlation, warnings


def _on_multiplier(mean: Tensor, variance: Tensor) -> tuple[str, ...]:
    """Return a warning if the multiplier is poorly determined by the data."""
    size, spread = float(mean.abs().median()), float(variance.sqrt().median())
    if spread <= UNDETERMINED * max(size, 1e-12):
        return ()
    return (
        f"the multiplier is not determined by these data: its standard deviation is {spread:.3g} N at a "
        f"median of {size:.3g} N; use the analytical mean, measure a force, or omit priors along the normal",
    )
