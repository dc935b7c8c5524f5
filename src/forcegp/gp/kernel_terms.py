"""Functions k(x, X) w as sums that are cheap to evaluate at many x."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from forcegp.gp.decomposition import split
from forcegp.gp.features import Features, stacked
from forcegp.gp.kernels import Kernel, Linear, Parameters, Product, Stationary, Sum, sub
from forcegp.gp.pathwise import Basis


def kernel_terms(kernel: Kernel, params: Parameters, X: Features, w: Tensor) -> list[tuple[Basis, Tensor]]:
    """k(x, X) w as a sum of functions of x, each with its weights.

    Terms with a finite number of features are folded into weights of these. A stationary term whose
    length-scales all components share is evaluated once for all of them, and so is a product of such terms.

    Args:
        kernel: the kernel, of k components.
        params: its log-hyperparameters.
        X: n points.
        w: `(k, n, samples)`.

    Returns:
        Functions `(k or 1, ·, terms)`, each with weights `(k, terms, samples)`.
    """
    if isinstance(kernel, Sum) and not isinstance(kernel, Product):
        sides = ((getattr(kernel, side), sub(params, side)) for side in ("left", "right"))
        return [term for own, given in sides for term in kernel_terms(own, given, X, w)]
    finite = split(kernel)
    if finite.rest is None and finite.finite is not None:
        draw = finite.finite.features(params)
        return [(draw.basis, draw.basis(X).mT @ w)]
    common = _common(kernel, params, X)
    if common is None:
        return [(kernel.towards(params, X), w)]
    return [(lambda x: torch.cat(common.functions(x), dim=-1), common.weights(w))]


@dataclass(frozen=True)
class _Common:
    """A kernel as Σ_t a_t g_t, with common functions g_t(x, X) `(1, ·, n)` and sizes a_t `(k,)`."""

    functions: Callable[[Features], list[Tensor]]
    sizes: list[Tensor]

    def weights(self, w: Tensor) -> Tensor:
        """a_t w of all terms, `(k, terms · n, samples)`."""
        return torch.cat([size[:, None, None] * w for size in self.sizes], dim=1)


def _common(kernel: Kernel, params: Parameters, X: Features) -> _Common | None:
    """The functions that all components have in common; `None` where they differ by more than factors."""
    if isinstance(kernel, Stationary) and len(params["log_lengthscale"]) == 1:
        g = kernel.towards({**params, "log_std": torch.zeros_like(params["log_std"][:1])}, X)
        return _Common(lambda x: [g(x)], [torch.exp(2.0 * params["log_std"])])
    if isinstance(kernel, Linear) and len(params["log_slope_std"]) == 1:
        slope, bias = torch.exp(2.0 * params["log_slope_std"]), kernel.bias_std(params).square()
        to = (stacked(X, kernel.inputs) * slope).mT
        size = torch.exp(2.0 * params["log_std"]) if kernel.shared else torch.ones_like(bias)

        def functions(x: Features) -> list[Tensor]:
            line = stacked(x, kernel.inputs) @ to
            # Components that have inputs of their own have a line each.
            lines = line if line.ndim == 3 else line[None]
            return [lines, lines.new_ones(1, 1, 1).expand_as(lines)]

        return _Common(functions, [size, bias])
    if isinstance(kernel, Product):
        left, right = (_common(getattr(kernel, side), sub(params, side), X) for side in ("left", "right"))
        if left is not None and right is not None:
            return _Common(
                lambda x: [a * b for a, b in product(left.functions(x), right.functions(x))],
                [a * b for a, b in product(left.sizes, right.sizes)],
            )
    return None
