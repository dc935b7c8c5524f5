"""Functions drawn from a sparse posterior, whose cost does not depend on the number of samples.

Matheron's rule on the inducing points: f(x) = f_prior(x) + V(x)ᵀ(w − Rᵀf_prior(Z)) with weights
w ~ N(A⁻¹v, A⁻¹), and φ(x)ᵀw for the part of the kernel that has exact features (Wilson et al. 2020).
"""

from __future__ import annotations

import torch
from torch import Tensor

from forcegp.gp.basis import LatentBasis, ProcessBasis
from forcegp.gp.kernel_terms import kernel_terms
from forcegp.gp.pathwise import Basis, FunctionSamples

FEATURES = 256
"""Random features per component. Only what the inducing points miss is drawn from them: its covariance errs
by about 1/√FEATURES of its scale, and that of the rest not at all."""


def draw_functions(
    basis: LatentBasis, weights: Tensor, generator: torch.Generator, features: int
) -> FunctionSamples:
    """Functions with given weights of the basis functions, and what these miss drawn from the prior.

    Args:
        basis: basis functions.
        weights: drawn from their posterior `(size, samples)`.
        generator: source of randomness, on the CPU.
        features: random features of each component's prior.
    """
    terms = [
        _terms(part, weights[basis.of_process(p)], generator, features) for p, part in enumerate(basis.parts)
    ]
    return FunctionSamples(
        tuple(tuple(function for function, _ in own) for own in terms),
        tuple(tuple(w for _, w in own) for own in terms),
    )


def _terms(
    part: ProcessBasis, weights: Tensor, generator: torch.Generator, features: int
) -> list[tuple[Basis, Tensor]]:
    """The functions of one process that are summed, with their weights."""
    on_kernel, on_features = part.fold(weights)
    terms: list[tuple[Basis, Tensor]] = []
    rest = part.split.rest
    if rest is not None:
        draw = rest.kernel.draw(rest.parameters(part.params), features, generator)
        count = draw.basis(part.inducing).shape[-1]
        shape = (part.components, count, weights.shape[1])
        u = torch.randn(shape, dtype=torch.float64, generator=generator).to(weights)
        at_points = draw.basis(part.inducing) @ u
        terms += draw.terms(u)
        if part.to_inducing is not None:
            # R Rᵀ f_prior(Z) are the weights of k(x, Z) that interpolate the prior function.
            w = on_kernel - part.roots @ (part.roots.mT @ at_points)
            terms += kernel_terms(rest.kernel, rest.parameters(part.params), part.inducing, w)
    if part.finite is not None:
        terms.append((part.finite.basis, on_features))
    return terms
