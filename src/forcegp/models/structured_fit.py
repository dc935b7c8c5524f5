"""A fitted structured Gaussian process: forces conditioned on data, every quantity read off them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.identifiability import force_correlation
from forcegp.forces.learn import Problem, analytical_parameters, kernel_parameters
from forcegp.forces.measurements import Measurement, Training
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import CONTACT, JOINT, ForcePrior
from forcegp.forces.quantities import affine_maps, flat_states, stack, states
from forcegp.forces.samples import draw_samples
from forcegp.gp.exact import ExactPosterior
from forcegp.gp.optimise import Learned
from forcegp.gp.pathwise import FEATURES
from forcegp.models.base import FitResult, FittedModel, ForceField, Prediction
from forcegp.models.structured_spec import Specification, pack
from forcegp.storage.folder import Settings

KIND = "structured_gp"
CORRELATION_STATES = 50
"""Training states at which the correlation of Q and Q_z is evaluated after a fit."""
LARGE_JITTER = 0.01
"""Jitter, relative to unit noise, from which a fit warns: the noise grows by half of it."""


@dataclass(frozen=True, eq=False)
class StructuredFit(FittedModel):
    """Priors on forces conditioned on data, with learned hyperparameters.

    Attributes:
        specification: what was fitted.
        problem: the training data with the robot, priors and noise that explain them.
        hyperparameters: all learned tensors, by name.
        posterior: over latent forces.
        result: how the fit went.
        system: robot and contacts, with learned θ_A.
    """

    specification: Specification
    problem: Problem
    hyperparameters: Mapping[str, Tensor]
    posterior: ForcePosterior
    result: FitResult
    system: ConstrainedSystem

    kind = KIND
    has_function_samples = True

    @property
    def training(self) -> Training:
        """What the posterior is conditioned on."""
        return self.problem.training

    @torch.no_grad()
    def predict(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str | Sequence[str] = "qdd",
        *,
        active: Tensor | None = None,
        covariance: bool = True,
        system: ConstrainedSystem | None = None,
    ) -> Prediction:
        """Posterior mean and covariance of a quantity (eqs. 22 to 25).

        Args:
            q, qd, tau: `(*batch, nq)` states.
            quantity: a name of `QUANTITIES`, or several for their joint distribution.
            active: `(*batch, n_contacts)` bool, which contacts are closed; default all.
            covariance: whether to compute the covariance, which costs more than the mean.
            system: read the forces on another system, such as another surface or none at all.

        Returns:
            Mean `(*batch, d)` and covariance `(*batch, d, d)`, without measurement noise.

        Raises:
            UnknownNameError: no such quantity.
            ShapeError: a state or `active` does not fit the system.
        """
        system = system or self.system
        flat = flat_states(system, q, qd, tau, active)
        at = flat.at(system)
        z, parts = stack(affine_maps(system, at, quantity))
        mean = self.posterior.read_mean(system, at, z)
        spread = self.posterior.read_covariance(system, at, z) if covariance else None
        return Prediction(
            mean.reshape(*flat.batch, z.o.shape[-1]),
            None if spread is None else spread.reshape(*flat.batch, *spread.shape[-2:]),
            parts,
        )

    def force_field(self) -> ForceField:
        """Posterior mean of Q̄ = Q + Q_z, `(n, nq)` at states."""
        return self.posterior.total_force

    def force_samples(self, samples: int, generator: torch.Generator) -> ForceField:
        """Force functions drawn from the posterior."""
        return draw_samples(self.posterior, samples, generator, FEATURES).total_force

    def record(self) -> tuple[Settings, dict[str, Tensor]]:
        latent = self.posterior.latent
        assert isinstance(latent, ExactPosterior)
        return pack(self.specification, self.training, self.hyperparameters, latent.alpha, self.result)


def learned_system(problem: Problem, hyperparameters: Mapping[str, Tensor]) -> ConstrainedSystem:
    """The system with the learned robot, detached."""
    if not analytical_parameters(hyperparameters):
        return problem.system
    with torch.no_grad():
        return problem.system_at(hyperparameters)


@torch.no_grad()
def conditioned(
    specification: Specification,
    training: Training,
    hyperparameters: Mapping[str, Tensor],
    learned: Learned | None = None,
) -> StructuredFit:
    """Condition forces on training data at given hyperparameters.

    Args:
        specification: what is conditioned.
        training: the data.
        hyperparameters: of priors, noise and robot.
        learned: how they were learned.

    Raises:
        NumericalError: the covariance of the data is not positive definite.
    """
    problem = specification.problem(training)
    rows = problem.rows(hyperparameters)
    latent = ExactPosterior.of(problem.priors, kernel_parameters(hyperparameters), rows.blocks)
    system = learned_system(problem, hyperparameters)
    posterior = ForcePosterior(problem.priors, training.scales, problem.mean, latent)
    log_likelihood = float(latent.log_likelihood() - rows.constant)
    learned = learned or Learned({}, -log_likelihood, True, 0, 0.0, "conditioned, nothing learned")
    result = FitResult.of(
        learned,
        log_marginal_likelihood=log_likelihood,
        jitter=latent.conditioned.jitter,
        constant_inputs=_constant_inputs(problem.priors, training),
        force_correlation=_mean_correlation(posterior, system, training),
        warnings=_warnings(latent.conditioned.jitter),
    )
    return StructuredFit(specification, problem, hyperparameters, posterior, result, system)


def _constant_inputs(priors: Sequence[ForcePrior], training: Training) -> tuple[str, ...]:
    pairs = zip(priors, training.scales, strict=True)
    return tuple(f"{prior.name}.{name}" for prior, scale in pairs for name in scale.constant)


def _warnings(jitter: float) -> tuple[str, ...]:
    if jitter < LARGE_JITTER:
        return ()
    return (
        f"the covariance was factorised with a jitter of {jitter:.2g} times the noise variance: "
        "drop duplicated rows, or state a larger noise",
    )


def _mean_correlation(
    posterior: ForcePosterior, system: ConstrainedSystem, training: Training
) -> float | None:
    """Mean correlation of Q and Q_z over some of the training states, where both have priors."""
    targets = {prior.target for prior in posterior.priors}
    if not {JOINT, CONTACT} <= targets:
        return None
    few = training.thinned(min(CORRELATION_STATES, training.samples)).measurements
    parts = [force_correlation(posterior, system, states(system, *m.states)) for m in _in_contact(few)]
    return float(torch.cat(parts).mean()) if parts else None


def _in_contact(measurements: Sequence[Measurement]) -> list[Measurement]:
    """The samples in which a contact is closed; elsewhere Q_z is zero."""
    closed = [m[m.active.any(-1).nonzero()[:, 0]] for m in measurements]
    return [m for m in closed if len(m.q)]
