"""Exact posterior of latent processes given whitened rows (eqs. 11 and 22 to 24).

Memory use grows with the square of the number of rows. Fits that exceed the available memory are rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.gp.draws import FEATURES, FunctionSamples, draw_priors, kernel_terms
from forcegp.gp.factor import bordered
from forcegp.gp.features import (
    Block,
    Features,
    chunked,
    require_resolved_noise,
    require_resolved_variance,
    rows_mean,
)
from forcegp.gp.kernels import Parameters, Process, sub
from forcegp.gp.likelihood import Conditioned, add_rows, condition, cross_gram, gram, offsets, target_of
from forcegp.resources import announce_memory, free_memory

MATRICES_TO_LEARN = 3.0
"""Number of matrices `(rows, rows)` in memory during learning: the covariance, its factor and a copy."""
MATRICES_TO_CONDITION = 2.0
"""Number of matrices `(rows, rows)` in memory during conditioning: the covariance and its factor."""
SHARE = 0.8
"""Fraction of the free memory that exact inference may use."""
CHUNK_COLUMNS = 700
"""Number of columns per triangular solve, to limit memory use."""


@dataclass(frozen=True, eq=False)
class ExactPosterior:
    """Latent processes conditioned on rows.

    Attributes:
        processes: the kernels and the prefixes of their hyperparameters.
        params: log-hyperparameters.
        blocks: the rows.
        alpha: (K + I)⁻¹ y `(rows,)`, where the covariance K of the rows excludes errors.
        errors: number of processes, the last ones, whose mean is zero, so that they only widen error bars.
    """

    processes: tuple[Process, ...]
    params: Parameters
    blocks: list[Block]
    alpha: Tensor
    errors: int = 0

    @classmethod
    def of(
        cls, processes: Sequence[Process], params: Parameters, blocks: list[Block], errors: int = 0
    ) -> ExactPosterior:
        """Condition on rows.

        Raises:
            NumericalError: the covariance is not positive definite, or the noise is below rounding error.
        """
        fitted = condition(processes, params, blocks)
        if len(fitted.L):
            # K_ii + 1 is the squared norm of a row of the factor.
            require_resolved_noise(torch.linalg.vecdot(fitted.L, fitted.L).max())
        alpha = _without_errors(processes, params, blocks, errors) if errors else fitted.alpha
        result = cls(tuple(processes), params, blocks, alpha, errors)
        result.__dict__["conditioned"] = fitted
        return result

    @cached_property
    def conditioned(self) -> Conditioned:
        """Factorisation of the covariance of the rows. After loading, it is computed on first use."""
        require_exact_fits(self.blocks, learning=False)
        return condition(self.processes, self.params, self.blocks)

    @property
    def residual(self) -> float:
        """Mean square residual of the rows in units of the noise."""
        # y − K α = α
        return float(self.alpha.square().mean()) if len(self.alpha) else 0.0

    @property
    def jitter(self) -> float:
        """Jitter added to the diagonal, relative to unit noise."""
        return self.conditioned.jitter

    def updated(self, blocks: Sequence[Block]) -> ExactPosterior:
        """Condition on r additional rows in O(r n²); a new factorisation would take O((n + r)³).

        Raises:
            ModelError: exact inference does not fit into memory.
            NumericalError: the covariance of the rows is not positive definite.
        """
        old, new, together = self.conditioned, list(blocks), [*self.blocks, *blocks]
        require_exact_fits(together, learning=False)
        cross = cross_gram(self.processes, self.params, self.blocks, new)
        # Σ = [[L Lᵀ, C], [Cᵀ, K_new + I]], α = Σ⁻¹ y
        L, jitter = bordered(old.L, cross, gram(self.processes, self.params, new))
        joint = torch.cholesky_solve(target_of(together)[:, None], L)[:, 0]
        alpha = joint
        if self.errors:
            alpha = _without_errors(self.processes, self.params, together, self.errors)
        result = replace(self, blocks=together, alpha=alpha)
        result.__dict__["conditioned"] = Conditioned(L, joint, max(old.jitter, jitter))
        return result

    @cached_property
    def measured(self) -> tuple[bool, ...]:
        """Flags of the processes that affect at least one row. All other processes keep their prior."""
        return tuple(map(any, self._depends))

    @cached_property
    def _depends(self) -> list[list[bool]]:
        """Whether any row of each block depends on each process."""
        return [[bool(b.operators[p].any()) for b in self.blocks] for p in range(len(self.processes))]

    @cached_property
    def _process_params(self) -> list[dict[str, Tensor]]:
        """Log-hyperparameters of each process."""
        return [sub(self.params, process.prefix) for process in self.processes]

    @cached_property
    def weights(self) -> list[list[Tensor]]:
        """Weights `(components, n, 1)` for each process and block; products with k(x, X) sum to the mean."""
        weights, first = self.weights_of(self.alpha[:, None]), len(self.processes) - self.errors
        return [*weights[:first], *([torch.zeros_like(w) for w in each] for each in weights[first:])]

    def weights_of(self, rows: Tensor) -> list[list[Tensor]]:
        """Apply Wᵀ to vectors `(rows, s)`, yielding `(components, n, s)` for each process and block."""
        weights: list[list[Tensor]] = [[] for _ in self.processes]
        first = 0
        for block in self.blocks:
            by_sample = rows[first : first + block.rows].unflatten(0, block.target.shape)
            first += block.rows
            for p, W in enumerate(block.operators):
                weights[p].append(torch.einsum("nak,nas->kns", W, by_sample))
        return weights

    @cached_property
    def kernels_to_data(self) -> list[list[Callable[[Features], Tensor]]]:
        """Function x ↦ k(x, X) for each process and block."""
        return [
            [process.kernel.towards(self._process_params[p], block.features[p]) for block in self.blocks]
            for p, process in enumerate(self.processes)
        ]

    def latent_mean(self, p: int, features: Features, joint: bool = False) -> Tensor:
        """Return the posterior mean of process p at standardized features, `(n, components)`.

        Args:
            joint: whether errors are not zero, but have their posterior mean.
        """
        if not self.measured[p]:
            x, components = next(iter(features.values())), self.blocks[0].operators[p].shape[-1]
            return x.new_zeros(len(x), components)
        # μ(x) = k(x, X) Wᵀα (eqs. 11 and 23)
        weights = self.weights_of(self.conditioned.alpha[:, None]) if joint else self.weights
        pairs = zip(self.kernels_to_data[p], weights[p], strict=True)
        parts = [(kernel(features) @ w)[..., 0] for kernel, w in pairs]
        return sum(parts[1:], start=parts[0]).mT

    def mean(self, block: Block) -> Tensor:
        """Return the posterior mean Σ W f of the rows of each sample of a block, `(n, d)`."""
        return rows_mean(self.latent_mean, block)

    def covariance(self, block: Block) -> Tensor:
        """Return the posterior covariance `(n, d, d)` of the rows of each sample of a block, excluding noise.

        Raises:
            NumericalError: rounding errors dominate a variance.
        """
        n, d = block.target.shape
        if d == 0:  # for example, the multiplier of a system without contacts
            return block.target.new_zeros(n, 0, 0)
        parts = [block.target.new_zeros(0, d, d)]
        for chunk in chunked([block], max(1, CHUNK_COLUMNS // d)):
            # V = L⁻¹ Σ_X*
            V = torch.linalg.solve_triangular(self.conditioned.L, self._cross(chunk).mT, upper=False)
            V = V.reshape(len(V), -1, d).transpose(0, 1)
            # Σ_** = Σ_p W_p k_p(x, x) W_pᵀ
            prior = V.new_zeros(V.shape[0], d, d)
            for p, (x, W) in enumerate(zip(chunk.features, chunk.operators, strict=True)):
                variance = self.processes[p].kernel.diagonal(self._process_params[p], x)
                prior = prior + torch.einsum("nak,kn,nbk->nab", W, variance, W)
            # Σ* = Σ_** − Vᵀ V = Σ_** − Σ_*X Σ⁻¹ Σ_X* (eqs. 11 and 24)
            posterior = prior - V.mT @ V
            parts.append(require_resolved_variance(posterior, prior.diagonal(dim1=-2, dim2=-1)))
        covariance = torch.cat(parts)
        return 0.5 * (covariance + covariance.mT)

    def _cross(self, new: Block) -> Tensor:
        """Return Σ_*X, the covariance of new rows of any quantity with the data, `(new, rows)` (eq. 19)."""
        starts = offsets(self.blocks)
        cross = new.target.new_zeros(new.rows, starts[-1])
        for p, W in enumerate(new.operators):
            for g, depends in enumerate(self._depends[p]):
                if depends and bool(W.any()):
                    # Σ_*X = Σ_p W_* k_p(x_*, X) Wᵀ
                    k = self.kernels_to_data[p][g](new.features[p])
                    add_rows(cross[:, starts[g] : starts[g + 1]], W, k, self.blocks[g].operators[p])
        return cross

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood −½ yᵀ(K + I)⁻¹y − ½ log|K + I| − ½ n log 2π, without the constant of the rows."""
        return -float(self.conditioned.negative_log_likelihood(target_of(self.blocks)))

    def draw(self, count: int, generator: torch.Generator, features: int = FEATURES) -> FunctionSamples:
        """Draw functions f(x) + k(x, X) WᵀΣ⁻¹(y − W f(X) − ε) from the posterior (Matheron's rule).

        Here f is drawn from the prior, ε ~ N(0, I) and Σ = K + I.

        Args:
            generator: source of randomness, on the CPU.
            features: number of random features per component.
        """
        terms, at_rows = draw_priors(
            self.processes, self.params, self.blocks, self.measured, count, generator, features
        )
        # ε ~ N(0, I), β = Wᵀ (α − Σ⁻¹ (W f(X) + ε)), with α = Σ⁻¹ y unless there are errors
        like = self.alpha
        noise = torch.randn(len(like), count, dtype=torch.float64, generator=generator).to(like)
        weights = self.weights_of(-torch.cholesky_solve(at_rows + noise, self.conditioned.L))
        # f(x) = φ(x)ᵀ w + k(x, X) β
        for p, process in enumerate(self.processes):
            parts = zip(self.blocks, weights[p], self.weights[p], strict=True)
            for block, w, mean in parts if self.measured[p] else ():
                terms[p] += kernel_terms(process.kernel, self._process_params[p], block.features[p], mean + w)
        return FunctionSamples.of(terms)


def _without_errors(
    processes: Sequence[Process], params: Parameters, blocks: Sequence[Block], errors: int
) -> Tensor:
    """Return (K + I)⁻¹ y with the covariance K of all processes but the last ones, which are errors."""
    n = len(processes) - errors
    known = [replace(b, features=b.features[:n], operators=b.operators[:n]) for b in blocks]
    return condition(processes[:n], params, known).alpha


def exact_bytes(blocks: Sequence[Block], learning: bool = True) -> int:
    """Return the peak memory required for exact inference on whitened rows [bytes].

    Args:
        learning: whether hyperparameters are learned.
    """
    rows = sum(block.target.numel() for block in blocks)
    components = sum(W.shape[-1] for W in blocks[0].operators) if blocks else 0
    samples = [len(block.target) for block in blocks]
    kernels = max((n * n for n in samples), default=0) * components
    item = blocks[0].target.element_size() if blocks else 8
    return int(item * ((MATRICES_TO_LEARN if learning else MATRICES_TO_CONDITION) * rows**2 + kernels))


def require_exact_fits(blocks: Sequence[Block], learning: bool = True, available: int | None = None) -> None:
    """Reject exact inference that does not fit into memory, and warn if it needs most of the memory.

    Args:
        available: usable memory [bytes]; by default, a fraction `SHARE` of the free memory.

    Raises:
        ModelError: inference needs more memory than is available.
    """
    free = free_memory()
    allowed = (None if free is None else int(SHARE * free)) if available is None else available
    needed = exact_bytes(blocks, learning)
    rows = sum(block.target.numel() for block in blocks)
    samples = sum(len(block.target) for block in blocks)
    if allowed is not None and needed > allowed:
        raise ModelError(
            f"exact inference on {samples} samples ({rows} rows) does not fit into memory",
            expected=f"at most {allowed / 2**30:.1f} GiB",
            got=f"{needed / 2**30:.1f} GiB",
            hint='use inference="sparse", or fewer samples',
        )
    announce_memory(needed, f"exact inference on {samples} samples ({rows} rows)")
