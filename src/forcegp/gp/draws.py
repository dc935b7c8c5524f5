"""Functions drawn from a posterior by pathwise conditioning (Wilson et al. 2020), cheap to evaluate anywhere.

A function is drawn from the prior with random features and then corrected to match the data. Each sample is a
deterministic function, so a trajectory integrated under it satisfies Newton's equations and the constraint.

For a sparse posterior, Matheron's rule is applied at the inducing points, so the cost does not depend on the
number of samples: f(x) = f_prior(x) + V(x)ᵀ(w − Rᵀf_prior(Z)) with weights w ~ N(A⁻¹v, A⁻¹). The part of the
kernel that has exact features contributes φ(x)ᵀw.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.gp.basis import LatentBasis, ProcessBasis, split
from forcegp.gp.features import Basis, Block, FeatureMap, Features, stacked
from forcegp.gp.kernels import Kernel, Linear, Parameters, Process, Product, Stationary, Sum, sub

FEATURES = 1024
"""Number of random features per component; the covariance error of prior draws is about 1/√FEATURES."""
UNMEASURED = 4
"""Factor by which the number of features is reduced for processes that no row depends on."""


class FoldedSamples(NamedTuple):
    """Samples of one process, as weights of k(x, Z), of exact features, and of random features.

    Attributes:
        on_kernel: weights of k(x, Z) `(components, m, samples)`.
        on_features: weights of the exact features `(components, features, samples)`.
        missed: random features and their weights `(components, features, samples)`, for the residual that the
            inducing points do not represent; `None` if there is no residual.
    """

    on_kernel: Tensor
    on_features: Tensor
    missed: tuple[FeatureMap, Tensor] | None


@dataclass(frozen=True, eq=False)
class FunctionSamples:
    """Samples of latent processes, f_s(x) = Σ_t φ_t(x) w_ts.

    Attributes:
        bases: basis functions of each process, which take standardized features.
        weights: weights `(components, terms, samples)` for each basis of each process.
        folded: these samples in the form of one `FoldedSamples` per process, for a sparse posterior.
    """

    bases: tuple[tuple[Basis, ...], ...]
    weights: tuple[tuple[Tensor, ...], ...]
    folded: tuple[FoldedSamples, ...] | None = None

    @classmethod
    def of(
        cls, terms: Sequence[Sequence[tuple[Basis, Tensor]]], folded: tuple[FoldedSamples, ...] | None = None
    ) -> FunctionSamples:
        """Construct samples from the terms of each process, which are functions and their weights."""
        bases = tuple(tuple(basis for basis, _ in process_terms) for process_terms in terms)
        return cls(bases, tuple(tuple(w for _, w in process_terms) for process_terms in terms), folded)

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.weights[0][0].shape[-1]

    def latent(self, p: int, features: Features) -> Tensor:
        """Evaluate process p at n standardized inputs; the result is `(samples, n, components)`."""
        # f_s(x) = Σ_t φ_t(x) w_ts
        terms = zip(self.bases[p], self.weights[p], strict=True)
        return torch.stack([basis(features) @ w for basis, w in terms]).sum(0).permute(2, 1, 0)

    @cached_property
    def _weights_by_sample(self) -> list[list[Tensor]]:
        """Weights `(samples, components, terms)` for each basis of each process."""
        return [[w.permute(2, 0, 1).contiguous() for w in weights] for weights in self.weights]

    def by_runs(self, p: int, features: Features, samples: range, runs: int) -> Tensor:
        """Evaluate samples of process p, each at its own run of states, `(samples · runs, components)`."""
        parts = []
        for basis, w in zip(self.bases[p], self._weights_by_sample[p], strict=True):
            phi, w_runs = basis(features).unflatten(1, (len(samples), runs)), w[samples.start : samples.stop]
            if len(phi) == 1:
                parts.append(phi[0] @ w_runs.mT)
            else:
                parts.append(torch.einsum("ksrt,skt->srk", phi, w_runs))
        return sum(parts[1:], start=parts[0]).flatten(0, 1)


def draw_priors(
    processes: Sequence[Process],
    params: Parameters,
    blocks: Sequence[Block],
    measured: Sequence[bool],
    count: int,
    generator: torch.Generator,
    features: int = FEATURES,
) -> tuple[list[list[tuple[Basis, Tensor]]], Tensor]:
    """Draw functions from the priors and evaluate them at the rows.

    Args:
        processes, params, blocks: as for `gram`.
        measured: for each process, whether any row depends on it.
        generator: source of randomness, on the CPU.
        features: number of random features per component.

    Returns:
        The functions of each process with their weights, and the values W f(X) `(rows, samples)`.
    """
    like, terms = blocks[0].target, []
    at_rows = like.new_zeros(sum(block.rows for block in blocks), count)
    for p, process in enumerate(processes):
        feature_count = features if measured[p] else max(1, features // UNMEASURED)
        x = blocks[0].features[p]
        draw = process.kernel.draw(sub(params, process.prefix), x, feature_count, generator)
        size = draw.basis(x).shape
        # f = φᵀw with w ~ N(0, I); W f(X) at the rows
        w = torch.randn(size[0], size[2], count, dtype=torch.float64, generator=generator).to(like)
        latent = ((block.operators[p], draw.basis(block.features[p]) @ w) for block in blocks)
        at_rows += torch.cat([torch.einsum("nak,kns->nas", W, f).flatten(0, 1) for W, f in latent])
        terms.append(draw.weighted(w))
    return terms, at_rows


def kernel_terms(kernel: Kernel, params: Parameters, X: Features, w: Tensor) -> list[tuple[Basis, Tensor]]:
    """Return k(x, X) w as a sum of weighted functions of x.

    Terms with finitely many features are converted to weights of these features. A stationary term whose
    length-scales are shared by all components, or a product of such terms, is evaluated only once.

    Args:
        X: n points.
        w: weights `(k, n, samples)`.

    Returns:
        Functions `(k or 1, ·, terms)` with their weights `(k, terms, samples)`.
    """
    if isinstance(kernel, Sum) and not isinstance(kernel, Product):
        return [term for k, theta in kernel.parts(params) for term in kernel_terms(k, theta, X, w)]
    parts = split(kernel, params)
    if parts.rest is None and parts.finite is not None:
        # k(x, X) w = φ(x)ᵀ (φ(X) w)
        draw = parts.finite.features(X)
        return [(draw.basis, draw.basis(X).mT @ w)]
    common = _common(kernel, params, X)
    if common is None:
        return [(kernel.towards(params, X), w)]
    functions, sizes = common
    weights = torch.cat([size[:, None, None] * w for size in sizes], dim=1)
    return [(lambda x: torch.cat(functions(x), dim=-1), weights)]


def _common(
    kernel: Kernel, params: Parameters, X: Features
) -> tuple[Callable[[Features], list[Tensor]], list[Tensor]] | None:
    """Return the terms of a kernel Σ_t a_t g_t with functions g_t(x, X) `(1, ·, n)` common to all components
    and factors a_t `(k,)`; `None` if the components differ by more than constant factors.
    """
    if isinstance(kernel, Stationary) and len(params["log_lengthscale"]) == 1:
        g = kernel.towards({**params, "log_std": torch.zeros_like(params["log_std"][:1])}, X)
        return lambda x: [g(x)], [torch.exp(2.0 * params["log_std"])]
    if isinstance(kernel, Linear) and len(params["log_slope_std"]) == 1:
        slope, bias = torch.exp(2.0 * params["log_slope_std"]), kernel.bias_std(params).square()
        to = (stacked(X, kernel.inputs) * slope).mT
        size = torch.exp(2.0 * params["log_std"]) if kernel.shared else torch.ones_like(bias)

        def functions(x: Features) -> list[Tensor]:
            line = stacked(x, kernel.inputs) @ to
            # Components with separate inputs have one line each.
            lines = line if line.ndim == 3 else line[None]
            return [lines, lines.new_ones(1, 1, 1).expand_as(lines)]

        return functions, [size, bias]
    if isinstance(kernel, Product):
        left, right = (_common(side, theta, X) for side, theta in kernel.parts(params))
        if left is not None and right is not None:
            f, g = left[0], right[0]
            sizes = [a * b for a, b in product(left[1], right[1])]
            return lambda x: [a * b for a, b in product(f(x), g(x))], sizes
    return None


MISSED_FEATURES = 256
"""Number of random features per component. They represent only the residual that the inducing points leave,
and the relative error of its covariance is about 1/√MISSED_FEATURES. The other part is exact.
"""


def draw_functions(
    basis: LatentBasis, weights: Tensor, generator: torch.Generator, features: int
) -> FunctionSamples:
    """Return functions with the given basis weights, and with a residual drawn from the prior.

    Args:
        weights: weights drawn from the posterior `(size, samples)`.
        generator: source of randomness, on the CPU.
        features: number of random features for the prior of each component.
    """
    folded = [
        _folded(part, weights[basis.of_process(p)], generator, features) for p, part in enumerate(basis.parts)
    ]
    terms = [_terms(part, each) for part, each in zip(basis.parts, folded, strict=True)]
    return FunctionSamples.of(terms, tuple(folded))


def _folded(part: ProcessBasis, weights: Tensor, generator: torch.Generator, features: int) -> FoldedSamples:
    """Return the samples of one process, given the weights of its basis functions."""
    on_kernel, on_features = part.fold(weights)
    rest = part.split.rest
    if rest is None:
        return FoldedSamples(on_kernel, on_features, None)
    # f_prior(Z) = φ(Z)ᵀ u with u ~ N(0, I)
    draw = rest.kernel.draw(rest.params, part.inducing, features, generator)
    at_points = draw.basis(part.inducing)
    shape = (part.components, at_points.shape[-1], weights.shape[1])
    u = torch.randn(shape, dtype=torch.float64, generator=generator).to(weights)
    if part.to_inducing is not None:
        # R Rᵀ f_prior(Z) are the weights of k(x, Z) that interpolate the prior function.
        on_kernel = on_kernel - part.roots @ (part.roots.mT @ (at_points @ u))
    return FoldedSamples(on_kernel, on_features, (draw, u))


def _terms(part: ProcessBasis, samples: FoldedSamples) -> list[tuple[Basis, Tensor]]:
    """Return the functions whose sum is the process, with their weights."""
    terms: list[tuple[Basis, Tensor]] = []
    rest = part.split.rest
    if samples.missed is not None:
        draw, u = samples.missed
        terms += draw.weighted(u)
    if rest is not None and part.to_inducing is not None:
        terms += kernel_terms(rest.kernel, rest.params, part.inducing, samples.on_kernel)
    if part.finite is not None:
        terms.append((part.finite.basis, samples.on_features))
    return terms
