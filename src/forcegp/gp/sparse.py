"""Sparse posterior of latent components, computed from two sums over the samples.

With A = I + Σ V_i S_i V_iᵀ and v = Σ V_i W_iᵀ y_i, the latent mean is V_*ᵀA⁻¹v, and the latent covariance is
k_** − V_*ᵀV_* + V_*ᵀA⁻¹V_* (Titsias 2009; Hensman et al. 2013). The cost of a prediction does not depend on
the number of samples.

The last processes may be errors of zero mean, which only widen error bars. Given that they are zero, the mean
of the other weights o is A_oo⁻¹ v_o. The leading block of the factor of A is the factor of A_oo.

The weights of some basis functions may drift, so that some components change while others do not. A drifting
weight is an Ornstein–Uhlenbeck process whose stationary distribution is the prior: w′ = ρ w + √(1 − ρ²) ξ
with ξ ~ N(0, I). In information form (A = I + G, v), with drifting weights p and other weights o,

    S = A_pp + ρ²a I,  a = 1/(1 − ρ²),
    A′_oo = A_oo − A_op S⁻¹ A_po,  A′_op = ρa A_op S⁻¹,  A′_pp = a I − ρ²a² S⁻¹,
    v′_o = v_o − A_op S⁻¹ v_p,  v′_p = ρa S⁻¹ v_p.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.gp.basis import LatentBasis
from forcegp.gp.draws import MISSED_FEATURES, FunctionSamples, draw_functions
from forcegp.gp.factor import cholesky, extended
from forcegp.gp.features import (
    Block,
    Features,
    chunked,
    require_resolved_noise,
    require_resolved_variance,
    rows_mean,
)
from forcegp.gp.kernels import Parameters, Process
from forcegp.gp.sums import Moments, Sums, accumulate, add_rows


def drifted(sums: Sums, weights: Tensor, factor: float) -> Sums:
    """Let the given weights drift. Predictions that depend only on the other weights do not change.

    Args:
        sums: sums over the previous samples.
        weights: positions of the drifting weights `(k,)`.
        factor: correlation ρ of the new with the previous weights; 1 keeps them, and 0 restores their prior.

    Raises:
        ModelError: the factor is not between 0 and 1.
    """
    if not 0.0 <= factor <= 1.0:
        raise ModelError("invalid forgetting factor", expected="from 0 to 1", got=factor)
    if factor == 1.0 or not len(weights):
        return sums
    a, p = 1.0 / (1.0 - factor**2), weights
    A = sums.G + torch.eye(len(sums.G), dtype=sums.G.dtype, device=sums.G.device)
    eye = torch.eye(len(p), dtype=A.dtype, device=A.device)
    # S = A_pp + ρ²a I = L Lᵀ
    L = torch.linalg.cholesky(A[p][:, p] + factor**2 * a * eye)
    inverse = torch.cholesky_inverse(L)
    # A′_oo = A_oo − A_op S⁻¹ A_po, v′_o = v_o − A_op S⁻¹ v_p
    A_ap, gain = A[:, p], A[:, p] @ inverse
    G, v = sums.G - gain @ A_ap.mT, sums.v - gain @ sums.v[p]
    # A′_op = ρa A_op S⁻¹, A′_pp = a I − ρ²a² S⁻¹, v′_p = ρa S⁻¹ v_p
    G[:, p] = factor * a * gain
    G[p, :] = G[:, p].mT
    G[p[:, None], p[None, :]] = a * eye - (factor * a) ** 2 * inverse - eye
    v[p] = factor * a * (inverse @ sums.v[p])
    yy = sums.yy - sums.v[p] @ (inverse @ sums.v[p])
    return replace(sums, v=v, yy=yy, G=G)


MISSED = 0.1
"""Ratio of residual to posterior variance above which more inducing points would help."""


@dataclass(frozen=True)
class Diagnostics:
    """Variance that the inducing points of a sparse posterior do not represent.

    Attributes:
        size: number of basis functions.
        learned: effective number tr A⁻¹G of basis functions determined by the data. It equals the total
            posterior variance of all rows in units of the noise variance.
        missed: total residual prior variance of all rows in units of the noise variance.
    """

    size: int
    learned: float
    missed: float

    @property
    def more_points_would_help(self) -> bool:
        """Whether the residual variance is at least a tenth of the posterior variance."""
        return self.missed > MISSED * self.learned


MOMENTS = tuple(field.name for field in fields(Moments))
"""Names of the sums in a saved posterior."""
CHUNK_PREDICTIONS = 256
"""Number of samples for which covariances are computed at a time."""
UPDATE_FRACTION = 0.25
"""Ratio of the numbers of new rows and basis functions above which the factor is recomputed."""


@dataclass(frozen=True, eq=False)
class SparsePosterior:
    """Latent components conditioned on any number of samples, in terms of basis functions.

    Attributes:
        basis: basis functions.
        moments: sums over the samples other than G, which is recovered from the factor.
        L: lower Cholesky factor of A = I + G.
        jitter: jitter added to the diagonal, usually 0.0.
        errors: number of processes, the last ones, whose mean is zero.
    """

    basis: LatentBasis
    moments: Moments
    L: Tensor
    jitter: float = 0.0
    errors: int = 0

    @classmethod
    def of(cls, basis: LatentBasis, sums: Sums, errors: int = 0) -> SparsePosterior:
        """Factorise A = I + G.

        Args:
            errors: number of processes, the last ones, whose mean is zero.

        Raises:
            NumericalError: A is not positive definite, for example after removing samples that were not
                added.
        """
        # A = I + G = L Lᵀ
        A = sums.G + torch.eye(len(sums.G), dtype=sums.G.dtype, device=sums.G.device)
        L, jitter = cholesky(A)
        result = cls(basis, Moments(*sums.tensors[:-1]), L, jitter, errors)
        result.__dict__["sums"] = sums
        return result

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors to save, keyed by name; processes and hyperparameters are saved separately."""
        tensors = {f"moments.{name}": getattr(self.moments, name) for name in MOMENTS}
        tensors |= {"L": self.L, "jitter": torch.tensor(self.jitter, dtype=torch.float64)}
        tensors |= self.basis.tensors()
        # Each tensor is copied, since files do not store views.
        return {name: x.detach().clone(memory_format=torch.contiguous_format) for name, x in tensors.items()}

    @classmethod
    def of_tensors(
        cls,
        processes: Sequence[Process],
        params: Parameters,
        tensors: Mapping[str, Tensor],
        errors: int = 0,
    ) -> SparsePosterior:
        """Restore a posterior from `tensors`.

        Raises:
            ModelError: a tensor is missing or does not match the processes.
        """
        try:
            basis = LatentBasis.of_tensors(processes, params, tensors)
            moments = Moments(*(tensors[f"moments.{name}"] for name in MOMENTS))
            L, jitter = tensors["L"], float(tensors["jitter"])
        except KeyError as error:
            raise ModelError("a saved sparse posterior is incomplete", expected=f"a tensor {error}") from None
        size = (basis.size, basis.size)
        if L.shape != size or moments.v.shape != size[:1] or moments.prior.shape != (len(processes),):
            raise ModelError(
                "a saved sparse posterior does not match its processes",
                expected=f"{basis.size} basis functions of {len(processes)} processes",
                got=f"{len(moments.v)} of {len(moments.prior)}",
            )
        # Files are row-major; the factor is column-major, as LAPACK returns it.
        return cls(basis, moments, L.mT.contiguous().mT, jitter, errors)

    @cached_property
    def sums(self) -> Sums:
        """All sums over the samples; G is recovered from the factor if samples were added to the factor."""
        eye = torch.eye(len(self.L), dtype=self.L.dtype, device=self.L.device)
        return Sums(**vars(self.moments), G=self.L @ self.L.mT - (1.0 + self.jitter) * eye)

    @property
    def leading(self) -> int:
        """Number of weights of the processes that are not errors."""
        first = len(self.basis.parts) - self.errors
        return self.basis.of_process(first).start if self.errors else len(self.L)

    @cached_property
    def weights(self) -> Tensor:
        """Mean of the weights of the basis functions, given that errors are zero, `(size,)`."""
        # A_oo⁻¹ v_o, 0
        k = self.leading
        mean = torch.cholesky_solve(self.moments.v[:k, None], self.L[:k, :k])[:, 0]
        return torch.cat([mean, torch.zeros_like(self.moments.v[k:])])

    @cached_property
    def joint_weights(self) -> Tensor:
        """Posterior mean A⁻¹v of the weights of the basis functions, including errors, `(size,)`."""
        return torch.cholesky_solve(self.moments.v[:, None], self.L)[:, 0]

    @property
    def log_likelihood(self) -> float:
        """Collapsed lower bound on the exact log-likelihood log p(y) (Titsias 2009)."""
        # F = −½ [Σ y² − vᵀA⁻¹v + log|A| + rows log 2π + Σ tr W(k − VᵀV)Wᵀ], log|A| = 2 Σ log L_ii
        moments = self.moments
        fit = moments.yy - moments.v @ self.joint_weights
        log_determinant = 2.0 * self.L.diagonal().abs().log().sum()
        constant = moments.rows * math.log(2.0 * math.pi)
        return -float(0.5 * (fit + log_determinant + constant + moments.missed.sum()))

    @property
    def residual(self) -> float:
        """Mean square residual of the rows in units of the noise."""
        # |y − Φ w|² = yᵀy − vᵀw − wᵀw with (I + ΦᵀΦ) w = v, in the rows where w is not zero
        w, rows = self.weights, self.moments.rows.clamp(min=1.0)
        return max(0.0, float((self.moments.yy - self.moments.v @ w - w @ w) / rows))

    @cached_property
    def measured(self) -> tuple[bool, ...]:
        """Flags of the processes that affect at least one row. All other processes keep their prior."""
        # The factor of A = I + G is that of the identity where G is zero.
        diagonal = self.L.diagonal().abs()
        slices = (self.basis.of_process(p) for p in range(len(self.basis.parts)))
        return tuple(bool((diagonal[columns] > 1.0).any()) for columns in slices)

    @cached_property
    def folded(self) -> list[tuple[Tensor, Tensor]]:
        """Posterior mean of each process, as weights of k(x, Z) and of its exact features."""
        return self.folded_by(self.weights)

    def folded_by(self, weights: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return weights `(size,)` of the basis functions as weights of k(x, Z) and of exact features."""
        columns = (weights[self.basis.of_process(p), None] for p in range(len(self.basis.parts)))
        return [part.fold(w) for part, w in zip(self.basis.parts, columns, strict=True)]

    def latent_mean(self, p: int, features: Features, joint: bool = False) -> Tensor:
        """Return the posterior mean of process p, `(n, components)`.

        Args:
            joint: whether errors are not zero, but have their posterior mean.
        """
        # μ(x) = V(x)ᵀ A⁻¹v = k(x, Z) (R m) + φ(x)ᵀ m (eq. 23)
        folded = self.folded_by(self.joint_weights) if joint else self.folded
        return self.basis.parts[p].mean(features, folded[p])

    def mean(self, block: Block) -> Tensor:
        """Return the posterior mean Σ W f of the rows of each sample of a block, `(n, d)`."""
        return rows_mean(self.latent_mean, block)

    @cached_property
    def _inverse_factor(self) -> list[Tensor]:
        """L⁻ᵀ for each process, with one block of rows per component `(components, width, size)`.

        The basis functions of a component involve only the rows of that component. The other rows of L⁻ᵀ can
        be skipped, which is not possible in a triangular solve.
        """
        eye = torch.eye(len(self.L), dtype=self.L.dtype, device=self.L.device)
        inverse = torch.linalg.solve_triangular(self.L, eye, upper=False).mT
        blocks = []
        for p, part in enumerate(self.basis.parts):
            filled = inverse.new_zeros(part.used.numel(), len(inverse))
            filled[part.columns] = inverse[self.basis.of_process(p)]
            blocks.append(filled.unflatten(0, part.used.shape))
        return blocks

    def _root(self, block: Block) -> tuple[Tensor, Tensor, Tensor]:
        """Return R `(n, d, size)`, where R Rᵀ is the covariance represented by the basis.

        Also return the residual and prior variances k(x, x) of the approximated part of all components, each
        `(n, components)`. Squares of exact features do not cancel.
        """
        root: Tensor | float = 0.0
        missed, prior = [], []
        parts = zip(self.basis.parts, self._inverse_factor, block.features, block.operators, strict=True)
        for part, inverse, x, W in parts:
            # R = W Vᵀ L⁻ᵀ, so that R Rᵀ = W Vᵀ A⁻¹ V Wᵀ
            V, explained = part.values(x)
            one = V.shape[-1] == 1
            root = root + (
                (W * V[..., 0].mT[:, None]) @ inverse[:, 0] if one else W @ (V @ inverse).transpose(0, 1)
            )
            prior.append(part.rest_variance(x))
            missed.append(part.missed(prior[-1], explained))
        assert isinstance(root, Tensor)
        return root, torch.cat(missed).mT, torch.cat(prior).mT

    def covariance(self, block: Block) -> Tensor:
        """Return the posterior covariance `(n, d, d)` of the rows of each sample, excluding noise.

        Args:
            block: kernel inputs and operators of each process; the targets are not used.

        Raises:
            NumericalError: rounding errors dominate a variance.
        """
        d = block.target.shape[1]
        parts = [block.target.new_zeros(0, d, d)]
        for chunk in chunked([block], CHUNK_PREDICTIONS):
            W = torch.cat(chunk.operators, dim=-1)
            root, missed, prior = self._root(chunk)
            # Σ* = R Rᵀ + W diag(k − |V|²) Wᵀ (eq. 24)
            posterior = root @ root.mT + (W * missed[:, None]) @ W.mT
            parts.append(require_resolved_variance(posterior, (W.square() @ prior[..., None])[..., 0]))
        covariance = torch.cat(parts)
        return 0.5 * (covariance + covariance.mT)

    def require_resolved(self) -> None:
        """Reject a prior whose variance is so large that double precision cannot resolve the noise.

        Raises:
            NumericalError: the prior variance of the approximated part is too large.
        """
        if float(self.moments.rows) > 0.0:
            require_resolved_noise(self.moments.prior.sum() / self.moments.rows)

    @cached_property
    def diagnostics(self) -> Diagnostics:
        """Posterior variance of the rows, and residual variance not represented by the inducing points."""
        # tr A⁻¹G = size − tr A⁻¹ = size − |L⁻ᵀ|²
        inverse = sum((block**2).sum() for block in self._inverse_factor)
        size = self.basis.size
        return Diagnostics(size, float(size - inverse), float(self.moments.missed.sum()))

    def draw(
        self, count: int, generator: torch.Generator, features: int = MISSED_FEATURES
    ) -> FunctionSamples:
        """Draw functions from the posterior.

        Args:
            generator: source of randomness, on the CPU.
            features: number of random features per component.
        """
        # w = m + L⁻ᵀ ξ ~ N(m, A⁻¹)
        m = self.weights[:, None]
        normal = torch.randn(len(m), count, dtype=torch.float64, generator=generator).to(m)
        weights = m + torch.linalg.solve_triangular(self.L.mT, normal, upper=True)
        return draw_functions(self.basis, weights, generator, features)

    def updated(self, blocks: Sequence[Block]) -> SparsePosterior:
        """Condition on additional samples. The cost does not depend on the number of previous samples.

        Raises:
            NumericalError: the factorisation fails.
        """
        rows = sum(block.rows for block in blocks)
        if rows > UPDATE_FRACTION * self.basis.size or self.L.device.type != "cpu":
            return self._with(self.sums + accumulate(self.basis, blocks))
        # A′ = A + ΦᵀΦ
        moments, Phi = add_rows(self.basis, self.moments, blocks)
        return replace(self, moments=moments, L=extended(self.L, Phi))

    def forgetting(self, factor: float) -> SparsePosterior:
        """Multiply the weight of all previous samples by `factor`; 0 restores the prior.

        Raises:
            ModelError: the factor is not between 0 and 1.
        """
        return self._with(self.sums.scaled(factor))

    def drifting(self, factor: float, processes: Sequence[int]) -> SparsePosterior:
        """Let the weights of the given processes drift towards their prior. Other weights do not change.

        Raises:
            ModelError: the factor is not between 0 and 1.
        """
        columns = torch.arange(self.basis.size, device=self.L.device)
        weights = torch.cat([columns[self.basis.of_process(p)] for p in processes])
        return self._with(drifted(self.sums, weights, factor))

    def without(self, blocks: Sequence[Block]) -> SparsePosterior:
        """Remove samples that the posterior was conditioned on.

        Raises:
            ModelError: there are more rows than the posterior was conditioned on.
            NumericalError: the posterior was not conditioned on these samples.
        """
        return self._with(self.sums - accumulate(self.basis, blocks))

    def _with(self, sums: Sums) -> SparsePosterior:
        return SparsePosterior.of(self.basis, sums, self.errors)
