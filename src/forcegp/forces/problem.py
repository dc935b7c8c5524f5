"""The problem of learning forces: its rows, their likelihood, and the forces conditioned on them.

Conditioning is exact, or sparse with features and inducing points. Sparse conditioning processes a log piece
by piece, accumulating sums over the samples that determine the posterior.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.forces.measurements import Measurement, Training, scaled
from forcegp.forces.noise import TORQUE_NOISE, ForceNoise, SampleNoise, state_jacobian
from forcegp.forces.posterior import ForcePosterior, ForceProcess, hidden_variance, trained_region
from forcegp.forces.priors.base import ANALYTICAL, NOISE, RESERVED, ForceMean, ForcePrior
from forcegp.forces.priors.constants import PerRecording
from forcegp.forces.priors.contact import CoulombErrorPrior, CoulombFriction, coulomb_of
from forcegp.forces.projection import WhitenedRows, combine, whiten
from forcegp.forces.term import NEAR_REST, ExpectedForce
from forcegp.forces.unknowns import tip_factor
from forcegp.gp.basis import LatentBasis, latent_basis
from forcegp.gp.exact import ExactPosterior, require_exact_fits
from forcegp.gp.features import Features, Standardization
from forcegp.gp.inducing import CANDIDATES, LIMIT, select_inducing
from forcegp.gp.likelihood import negative_log_likelihood, negative_log_likelihood_of_weights
from forcegp.gp.sparse import SparsePosterior
from forcegp.gp.sums import Sums, accumulate, without_feedback

Tensors = dict[str, Tensor]
OWN = tuple(name + "." for name in RESERVED)
"""Prefixes of learned parameters other than the hyperparameters of the priors."""
REGION_STATES = 10_000
"""Maximum number of training states used to compute the trained region."""


def _even(index: Tensor, count: int) -> Tensor:
    """Return at most `count` evenly spaced entries."""
    return index[:: max(1, math.ceil(len(index) / count))]


def kernel_parameters(tensors: Mapping[str, Tensor]) -> Tensors:
    """Extract the hyperparameters of the priors from the learned tensors."""
    return {key: x for key, x in tensors.items() if not key.startswith(OWN)}


def analytical_parameters(tensors: Mapping[str, Tensor]) -> Tensors:
    """Extract the analytical parameters θ_A from the learned tensors, keyed by their names in the module."""
    prefix = ANALYTICAL + "."
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def noise_key(measurement: int) -> str:
    """Return the name of the learned noise of the measurement with the given index."""
    return f"{NOISE}.{measurement}.log_noise_std"


@dataclass(frozen=True)
class Problem:
    """The components of the likelihood of a model with force priors.

    Attributes:
        system: robot and contacts; their parameters are fixed unless θ_A is learned.
        priors: the force priors.
        mean: prior mean of Q.
        training: measurements, noise and input scales.
        parameters: module whose `forward()` returns the robot at θ_A, or `None`.
        torque_std: standard deviation `(nq,)` of the white noise of the motor torque, unless it is learned.
        power: exponent κ of the likelihood, which is below 1 if samples are correlated.
        correlation: correlation time `(nq,)` of the noise of each torque [s]; `None` if unknown.
        inducing: inducing inputs of each prior, for sparse inference; `None` for exact inference.
        state_std: standard deviation of the noise of q and q̇, `(2 nq,)`, or `None` if there is none.
        external_std: standard deviation of unknown forces on the joints `(nq,)`, or `None` if there are none.
    """

    system: ConstrainedSystem
    priors: tuple[ForcePrior, ...]
    mean: ForceMean
    training: Training
    parameters: nn.Module | None = None
    torque_std: Tensor | None = None
    power: float = 1.0
    correlation: Tensor | None = None
    inducing: tuple[Features, ...] | None = None
    state_std: Tensor | None = None
    external_std: Tensor | None = None

    def without_priors(self, names: Collection[str]) -> Problem:
        """Return the problem without the priors that have the given names."""
        kept = [p for p, prior in enumerate(self.priors) if prior.name not in names]
        inducing = None if self.inducing is None else tuple(self.inducing[p] for p in kept)
        scales = tuple(self.training.scales[p] for p in kept)
        training = dataclasses.replace(self.training, scales=scales)
        priors = tuple(self.priors[p] for p in kept)
        return dataclasses.replace(self, priors=priors, training=training, inducing=inducing)

    def with_priors(self, priors: Sequence[ForcePrior], source: Problem | None = None) -> Problem:
        """Return the problem with more priors, which have no inducing points.

        Args:
            source: a problem with the input scales of these priors; computed from the samples by default.
        """
        if source is None:
            scales = scaled(self.training, self.system, priors, {}).scales
        else:
            known = {p.name: s for p, s in zip(source.priors, source.training.scales, strict=True)}
            scales = tuple(known[prior.name] for prior in priors)
        training = dataclasses.replace(self.training, scales=(*self.training.scales, *scales))
        more = dataclasses.replace(self, priors=(*self.priors, *priors), training=training, inducing=None)
        if self.inducing is None:
            return more
        empty = without_inducing(more).inducing or ()
        return dataclasses.replace(more, inducing=(*self.inducing, *empty[len(self.priors) :]))

    @property
    def errors(self) -> tuple[ForcePrior, ...]:
        """Priors on errors of what the robot includes. They come after all other priors."""
        return tuple(prior for prior in self.priors if prior.is_error)

    def without_errors(self) -> Problem:
        """Return the problem without errors of what the robot includes."""
        return self.without_priors([prior.name for prior in self.errors])

    def system_at(self, tensors: Mapping[str, Tensor]) -> ConstrainedSystem:
        """Return the system with the robot evaluated at the analytical parameters in the tensors."""
        theta = {} if self.parameters is None else analytical_parameters(tensors)
        if self.parameters is None or not theta:
            return self.system
        return self.system.with_robot(torch.func.functional_call(self.parameters, theta, ()))

    def noise_at(self, tensors: Mapping[str, Tensor], measurement: int) -> Tensor:
        """Return the noise `(d,)` or `(n, d)` of a measurement; learned noise scales per-sample noise."""
        std = self.training.noise_std[measurement]
        learned = tensors.get(noise_key(measurement))
        if learned is None:
            return std
        return learned.exp() if std.ndim == 1 else std * (learned.exp() / typical(std))

    def coulomb(self, tensors: Mapping[str, Tensor]) -> tuple[CoulombFriction, ...]:
        """Return the Coulomb friction at the contacts, with initial values for missing parameters."""
        return coulomb_of(self.priors, tensors, self.system.robot.mass) if self.has_coulomb else ()

    @property
    def has_coulomb(self) -> bool:
        """Whether any prior is coupled to Coulomb friction, which is proportional to the multiplier."""
        return any(prior.coupled for prior in self.priors)

    def showing_coulomb(self, samples: int) -> Problem:
        """Return the problem with at most about `samples` samples, half of them with a sliding contact.

        Only those show Coulomb friction, and in the log of a walking robot they are few. Both halves are
        evenly spaced. If half of the samples is more than all that slide, more of the others are taken.
        """
        system, rows = self.system, []
        contacts = [(law.contact, system.contact_names.index(law.contact)) for law in self.coulomb({})]
        for m in self.training.measurements:
            points = m.at(system).eom.contact_points
            most = math.ceil(samples * len(m.q) / self.training.samples)
            slides = [m.active[:, k] & (points[x].sliding[1].norm(dim=-1) > NEAR_REST) for x, k in contacts]
            moving = _even(torch.stack(slides).any(0).nonzero()[:, 0], max(1, most // 2))
            others = _even(torch.arange(len(m.q), device=m.q.device), max(1, most - len(moving)))
            rows.append(torch.cat([moving, others]).unique())
        return dataclasses.replace(self, training=self.training.of_rows(rows))

    def with_coulomb_errors(self, tensors: Mapping[str, Tensor]) -> tuple[Problem, Tensors]:
        """Add the error of learned Coulomb friction as a force to the problem and the tensors.

        The result is used for conditioning, but not for learning.
        """
        friction, expected = self.coulomb(tensors), ExpectedForce.of(self.priors, tensors)
        priors = tuple(CoulombErrorPrior(f.contact, friction, expected) for f in friction)
        one = self.system.robot.mass.new_zeros(1, 1)
        more, scale = len(priors), Standardization.none({"one": one})
        known = len(self.priors) - len(self.errors)

        def among(items: tuple[Any, ...], added: Any) -> tuple[Any, ...]:
            return (*items[:known], *more * (added,), *items[known:])

        return dataclasses.replace(
            self,
            priors=(*self.priors[:known], *priors, *self.priors[known:]),
            training=dataclasses.replace(self.training, scales=among(self.training.scales, scale)),
            inducing=None if self.inducing is None else among(self.inducing, {"one": one[:0]}),
        ), {**tensors, **{f"{prior.name}.log_scale": one[0] for prior in priors}}

    def force_noise(self, tensors: Mapping[str, Tensor]) -> ForceNoise | None:
        """Return the variance of the white noise on the joint force, or `None` if there is none."""
        learned = tensors.get(TORQUE_NOISE)
        std = self.torque_std if learned is None else learned.exp()
        if std is None and self.external_std is None:
            return None
        white = 0.0 if std is None else std**2
        return lambda at: white + hidden_variance(tensors, at, self.external_std)

    def state_factor(self, system: ConstrainedSystem, measurement: int) -> Tensor | None:
        """Return G Σ_x½ `(n, d, 2 nq)` of a measurement, or `None` if there is no state noise."""
        if self.state_std is None:
            return None
        m, slopes = self.training.measurements[measurement], self.training.slopes
        G = state_jacobian(system, m) if slopes is None else slopes[measurement]
        return None if G is None else G * self.state_std

    def process_at(self, tensors: Mapping[str, Tensor]) -> ForceProcess:
        """Return the prior on the forces, with learned operators and Coulomb friction."""
        return ForceProcess(self.priors, self.training.scales, self.mean, self.coulomb(tensors))

    def sample_noise(
        self, tensors: Mapping[str, Tensor], system: ConstrainedSystem, measurement: int
    ) -> SampleNoise:
        """Return the noise of the samples of a measurement."""
        weights = self.training.weights
        return SampleNoise(
            self.noise_at(tensors, measurement),
            self.force_noise(tensors),
            self.state_factor(system, measurement),
            None if weights is None else weights[measurement],
            self.training.measurements[measurement].tau_std,
            lambda at: tip_factor(tensors, system, at),
        )

    def rows(self, tensors: Mapping[str, Tensor]) -> WhitenedRows:
        """Return the whitened rows, evaluated at the noise and analytical parameters in the tensors."""
        system, process = self.system_at(tensors), self.process_at(tensors)
        return combine(
            [
                whiten(system, process, m, self.sample_noise(tensors, system, i))
                for i, m in enumerate(self.training.measurements)
            ]
        ).tempered(self.power)

    @cached_property
    def fixed_rows(self) -> WhitenedRows:
        """Return the rows evaluated with the given noise and robot."""
        return self.rows({})

    @torch.no_grad()
    def torque_residual(self) -> Tensor:
        """Return the RMS `(nq,)` of force residuals and of M times acceleration residuals [N m, N]."""
        squares = [torch.zeros_like(self.system.robot.mass)[None]]
        for m in self.training.measurements:
            at = m.at(self.system)
            mean = self.mean(self.system, at)
            if m.quantity == "qdd":
                residual = m.values - at.eom.acceleration(mean)
                squares.append((at.eom.M @ residual[..., None])[..., 0] ** 2)
            if m.quantity == "joint_force":
                squares.append((m.values - mean) ** 2)
        return (torch.cat(squares).sum(0) / max(sum(map(len, squares)) - 1, 1)).sqrt()

    @torch.no_grad()
    def typical_load(self) -> Tensor:
        """Return the RMS `(nq,)` of the motor, gravity and bias torques on each joint [N m, N]."""
        states = [m.at(self.system) for m in self.training.measurements]
        squares = [at.tau**2 + at.eom.Q_G**2 + at.eom.Q_C**2 for at in states]
        return torch.cat(squares).mean(0).sqrt()

    def torque(self, m: Measurement) -> Tensor:
        """Return the torques `(n, nq)` that act in the samples of a measurement."""
        return self.system.robot.true_torque(m.tau)

    @cached_property
    @torch.no_grad()
    def region(self) -> dict[str, Tensor]:
        """Region of speeds and torques in the training data, from at most `REGION_STATES` samples."""
        training = self.training.evenly(REGION_STATES)
        each = ((m.qd, self.torque(m)) for m in training.measurements)
        qd, tau = map(torch.cat, zip(*each, strict=True))
        return trained_region(qd, tau, dataclasses.replace(self, training=training).typical_load())

    def negative_log_likelihood(self, params: Tensors, rows: WhitenedRows) -> Tensor:
        """Return the negative log likelihood of the rows, computed in weight space if possible."""
        exact = self.inducing is None or not is_finite(self.priors)
        of = negative_log_likelihood if exact else negative_log_likelihood_of_weights
        return of(self.priors, params, rows.blocks) + rows.constant

    def rows_for(self, tensors: Tensors, held: Tensors) -> WhitenedRows:
        """Return the rows for given tensors. They are cached if they do not depend on the tensors."""
        keys = [*tensors, *held]
        depends = any(key.startswith(OWN) for key in keys)
        return self.rows({**held, **tensors}) if depends else self.fixed_rows


def typical(std: Tensor) -> Tensor:
    """Return one typical standard deviation per component, `(d,)`."""
    return std if std.ndim == 1 else std.square().mean(0).sqrt()


PIECE_SAMPLES = 2048
"""Number of samples whose equations of motion are kept in memory at a time."""


@dataclass(frozen=True, eq=False)
class Totals:
    """State of sparse conditioning after part of the log has been processed.

    Attributes:
        sums: sums over the whitened rows.
        constant: part `()` of the negative log likelihood that is independent of the latent forces.
        samples: number of samples.
    """

    sums: Sums
    constant: Tensor
    samples: int

    @classmethod
    def zero(cls, problem: Problem, basis: LatentBasis) -> Totals:
        """Return the totals of an empty log."""
        like = next(iter(basis.params.values()))
        return cls(Sums.zero(basis, like), like.new_zeros(()), 0)

    def __add__(self, other: Totals) -> Totals:
        """Return the totals over the samples of both."""
        samples = self.samples + other.samples
        return Totals(self.sums + other.sums, self.constant + other.constant, samples)


def basis_of(problem: Problem, hyperparameters: Mapping[str, Tensor]) -> LatentBasis:
    """Return the basis functions of a problem that has inducing points.

    Raises:
        ModelError: inference is exact.
    """
    if problem.inducing is None:
        raise ModelError("exact inference has no basis functions", hint='use inference="sparse"')
    components = [prior.outputs(problem.system.robot) for prior in problem.priors]
    return latent_basis(problem.priors, kernel_parameters(hyperparameters), problem.inducing, components)


def remainder(priors: Sequence[ForcePrior], basis: LatentBasis) -> Tensor:
    """Return the positions of the weights that are learned from what all others leave."""
    parts = [torch.arange(basis.size)[basis.of_process(p)] for p, f in enumerate(priors) if f.remainder]
    return torch.cat([torch.arange(0), *parts]).to(next(iter(basis.params.values())).device)


@torch.no_grad()
def total_over(
    problem: Problem,
    hyperparameters: Mapping[str, Tensor],
    basis: LatentBasis,
    pieces: Iterable[Training],
    after: Callable[[Totals], None] = lambda _: None,
) -> Totals:
    """Return the totals over the pieces of a log. The memory needed does not depend on their number.

    Args:
        problem: source of the robot, priors and noise; its training data are not used.
        pieces: the samples, possibly from a generator.
        after: function called after each piece.
    """
    total = Totals.zero(problem, basis)
    for piece in pieces:
        piece_problem = dataclasses.replace(problem, training=piece)
        rows = piece_problem.rows(hyperparameters)
        total += Totals(accumulate(basis, rows.blocks), rows.constant, piece.samples)
        after(total)
    return total


def posterior_of(
    problem: Problem, hyperparameters: Mapping[str, Tensor], basis: LatentBasis, total: Totals
) -> ForcePosterior:
    """Return the forces conditioned on the samples in the totals.

    Raises:
        NumericalError: the sums are not finite, or the noise is negligible compared with the prior variance.
    """
    # A = I + Σ V S Vᵀ, w ~ N(A⁻¹v, A⁻¹)
    sums = without_feedback(total.sums, remainder(problem.priors, basis), True)
    latent = SparsePosterior.of(basis, sums, len(problem.errors))
    latent.require_resolved()
    return ForcePosterior(problem.process_at(hyperparameters), latent)


def of_unknown_recording(
    problem: Problem, hyperparameters: Mapping[str, Tensor], posterior: ForcePosterior
) -> ForcePosterior:
    """Return the posterior with constants of a recording that is not in the training data.

    Constants of the training recordings are marginalised.
    """
    latent, each = posterior.latent, [isinstance(prior, PerRecording) for prior in posterior.priors]
    if not any(each) or not isinstance(latent, SparsePosterior):
        return posterior
    basis, kept = latent.basis, torch.ones(latent.basis.size, dtype=torch.bool)
    priors, parts = list(posterior.priors), list(basis.parts)
    for p, prior in enumerate(posterior.priors):
        if isinstance(prior, PerRecording):
            # The last place is that of an unknown recording.
            kept[basis.of_process(p)].view(-1, len(prior.recordings) + 1)[:, :-1] = False
            priors[p], count = prior.prior, prior.prior.outputs(problem.system.robot)
            parts[p] = dataclasses.replace(parts[p], kernel=prior.prior.kernel, components=count)
    sums = latent.drifting(0.0, [p for p, differs in enumerate(each) if differs]).sums
    sums = dataclasses.replace(sums, G=sums.G[kept][:, kept], v=sums.v[kept])
    basis = LatentBasis(tuple(priors), basis.params, tuple(parts))
    process = dataclasses.replace(problem, priors=tuple(priors)).process_at(hyperparameters)
    return ForcePosterior(process, SparsePosterior.of(basis, sums, latent.errors))


EXACT_SAMPLES = 1000
"""Number of samples up to which inference is exact by default."""


def require_double(system: ConstrainedSystem) -> None:
    """Reject single-precision robots, for which rounding errors make covariance matrices indefinite.

    Raises:
        ModelError: the robot is not float64.
    """
    if system.robot.dtype != torch.float64:
        raise ModelError(
            f"Gaussian processes of {system.robot.name!r} need double precision",
            expected=torch.float64,
            got=system.robot.dtype,
            hint="convert the robot and the data, robot.to(dtype=torch.float64)",
        )


def is_finite(priors: Sequence[ForcePrior]) -> bool:
    """Return whether all priors have finitely many features, in which case sparse inference is exact."""
    return all(prior.kernel.is_finite for prior in priors)


def is_sparse(inference: str, priors: Sequence[ForcePrior], samples: int) -> bool:
    """Return whether inference is sparse. By default, it is sparse for finite priors and large data sets."""
    return inference == "sparse" or (inference == "auto" and (is_finite(priors) or samples > EXACT_SAMPLES))


@torch.no_grad()
def with_inducing(problem: Problem, hyperparameters: Mapping[str, Tensor], limit: int = LIMIT) -> Problem:
    """Return the problem with inducing points chosen from its data by conditional variance.

    Args:
        problem: problem with the samples to condition on.
        limit: maximum number of inducing points per prior.
    """
    training = problem.training
    few = dataclasses.replace(problem, training=training.evenly(CANDIDATES))
    blocks = few.rows(hyperparameters).blocks
    chosen = select_inducing(
        problem.priors,
        kernel_parameters(hyperparameters),
        blocks,
        rows=round(sum(block.rows for block in blocks) * training.all_samples / few.training.samples),
        limit=limit,
    )
    return dataclasses.replace(problem, inducing=tuple(selection.points for selection in chosen))


def without_inducing(problem: Problem) -> Problem:
    """Return the problem for sparse inference without inducing points, if it has finitely many features."""
    block = dataclasses.replace(problem, training=problem.training.evenly(1)).fixed_rows.blocks[0]
    empty = tuple({name: x[:0] for name, x in features.items()} for features in block.features)
    return dataclasses.replace(problem, inducing=empty)


def force_posterior(problem: Problem, hyperparameters: Mapping[str, Tensor]) -> ForcePosterior:
    """Return the forces conditioned on the data of a problem.

    Raises:
        NumericalError: the covariance of the data is not positive definite.
    """
    return forces_and_constant(problem, hyperparameters)[0]


@torch.no_grad()
def forces_and_constant(
    problem: Problem, hyperparameters: Mapping[str, Tensor]
) -> tuple[ForcePosterior, Tensor]:
    """Return the forces conditioned on a problem's data, and the likelihood term independent of the forces.

    Raises:
        ModelError: exact inference does not fit into memory.
        NumericalError: the covariance of the data is not positive definite.
    """
    if problem.inducing is not None:
        basis = basis_of(problem, hyperparameters)
        total = total_over(problem, hyperparameters, basis, problem.training.pieces(PIECE_SAMPLES))
        return posterior_of(problem, hyperparameters, basis, total), total.constant
    params, rows = kernel_parameters(hyperparameters), problem.rows(hyperparameters)
    require_exact_fits(rows.blocks, learning=False)
    # f | y ~ N(k Wᵀ Σ⁻¹ y, k − k Wᵀ Σ⁻¹ W k), Σ = W k Wᵀ + I (eqs. 22 to 24)
    latent = ExactPosterior.of(problem.priors, params, rows.blocks, len(problem.errors))
    return ForcePosterior(problem.process_at(hyperparameters), latent), rows.constant


def lost_by_inducing(posterior: ForcePosterior) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the kind of inference used for a posterior, and the information lost by inducing points.

    Returns:
        Fields of `FitResult`, and a warning if inducing points lose much of the information in the data.
    """
    if not isinstance(posterior.latent, SparsePosterior):
        return {"inference": "exact"}, ()
    diagnostics = posterior.latent.diagnostics
    warnings = (
        f"more inducing points would help: {diagnostics.size} basis functions leave a residual variance of "
        f"{diagnostics.missed:.3g}, compared with {diagnostics.learned:.3g} that the data determine; "
        "raise inducing_points of Inference",
    )
    return {
        "inference": "sparse",
        "basis_functions": diagnostics.size,
        "determined": diagnostics.learned,
        "missed": diagnostics.missed,
        "more_points_would_help": diagnostics.more_points_would_help,
    }, warnings if diagnostics.more_points_would_help else ()
