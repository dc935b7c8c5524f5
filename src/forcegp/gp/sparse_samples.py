"""Functions drawn from a sparse posterior, cheap to evaluate anywhere (pathwise conditioning).

Matheron's rule on the inducing variables: f(x) = f_prior(x) + V(x)ᵀ(w − Rᵀf_prior(Z)) with weights
w ~ N(A⁻¹v, A⁻¹), and φ(x)ᵀw for the part of the kernel with exact features (Wilson et al. 2020). Each sample
is one deterministic function whose cost does not depend on the number of data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.gp.kernels import Features
from forcegp.gp.sparse import SparsePosterior

Basis = Callable[[Features], Tensor]
"""x ↦ functions `(components, n, terms)`."""


@dataclass(frozen=True, eq=False)
class SparseSamples:
    """Functions drawn from a sparse posterior, as weighted sums.

    Attributes:
        bases: of each process, the functions that are summed: random features of the prior, covariances
            with the inducing points, exact features.
        weights: their weights, `(components, terms, samples)` each.
    """

    bases: tuple[tuple[Basis, ...], ...]
    weights: tuple[tuple[Tensor, ...], ...]

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.weights[0][0].shape[-1]

    def latent(self, p: int, features: Features, sample: Tensor | None = None) -> Tensor:
        """Values of process p.

        Args:
            p: index of the process.
            features: its kernel inputs at n states.
            sample: `(n,)` which sample each state belongs to; all samples at all states by default.

        Returns:
            `(samples, n, components)`, or `(n, components)` where `sample` is given.
        """
        terms = [(basis(features), w) for basis, w in zip(self.bases[p], self.weights[p], strict=True)]
        if sample is None:
            parts = [(k @ w).permute(2, 1, 0) for k, w in terms]
        else:
            parts = [torch.einsum("knj,kjn->nk", k, w[..., sample]) for k, w in terms]
        return sum(parts[1:], start=parts[0])


def draw_sparse_samples(
    posterior: SparsePosterior, count: int, generator: torch.Generator, features: int
) -> SparseSamples:
    """Draw functions from a sparse posterior.

    Args:
        posterior: what to draw from.
        count: number of functions.
        generator: source of randomness, on the CPU.
        features: random features of each component's prior.
    """
    m, size = posterior.weights, posterior.basis.size
    normal = torch.randn(size, count, dtype=torch.float64, generator=generator).to(m)
    w = m[:, None] + torch.linalg.solve_triangular(posterior.L.mT, normal, upper=True)
    bases, weights = [], []
    for p, part in enumerate(posterior.basis.parts):
        own: list[tuple[Basis, Tensor]] = []
        rest = part.split.rest
        if rest is not None:
            draw = rest.kernel.draw(rest.parameters(part.params), features, generator)
            terms = draw.basis(part.inducing).shape[-1]
            u = torch.randn(part.components, terms, count, dtype=torch.float64, generator=generator).to(m)
            own.append((draw.basis, u))
            if part.to_inducing is not None:
                prior_at_points = draw.basis(part.inducing) @ u
                on_kernel, _ = posterior.fold(p, w)
                # R Rᵀ f_prior(Z): the weights of k(x, Z) that interpolate the prior function.
                own.append((part.to_inducing, on_kernel - part.roots @ (part.roots.mT @ prior_at_points)))
        if part.finite is not None:
            own.append((part.finite.basis, posterior.fold(p, w)[1]))
        bases.append(tuple(basis for basis, _ in own))
        weights.append(tuple(weight for _, weight in own))
    return SparseSamples(tuple(bases), tuple(weights))
