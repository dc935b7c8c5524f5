"""Terms that are cheap to evaluate are the same functions as the kernel and the random features."""

from __future__ import annotations

import pytest
import torch

from forcegp.gp.draws import kernel_terms
from forcegp.gp.kernels import Constant, Kernel, Linear, Matern32, SquaredExponential

SAME = 1e-12
"""Of sums of some hundred terms in float64."""
K, N, S = 3, 20, 4
WIDTHS = {"q": 2, "qd": 2}
SPEED = Linear(("qd",), shared=True)
KERNELS = [
    Linear(("q",)) + SquaredExponential(("q",), shared=True),
    SPEED * SPEED * SquaredExponential(("q",), shared=True) + Matern32(("qd",), shared=True),
    Linear(("qd",), shared=True, offset=0.3) * SquaredExponential(("q",), shared=True),
    Constant() + SquaredExponential() + Linear(("q",)) * SquaredExponential(("qd",)),
    Linear(ard=False) + Linear(("q",), ard=False) * SquaredExponential(("qd",)),
]


kernels = pytest.mark.parametrize(
    "kernel", KERNELS, ids=["finite and rest", "products", "offset", "no common functions", "one slope"]
)


def _case(kernel: Kernel) -> tuple[dict, dict, dict, torch.Generator]:
    generator = torch.Generator().manual_seed(0)
    initial = kernel.initial(K, WIDTHS)
    params = {
        name: v + 0.3 * torch.randn(v.shape, dtype=v.dtype, generator=generator)
        for name, v in initial.items()
    }
    X, x = (
        {name: torch.randn(n, 2, dtype=torch.float64, generator=generator) for name in WIDTHS} for n in (N, 7)
    )
    return params, X, x, generator


@kernels
def test_terms_of_a_kernel_add_up_to_its_covariance(kernel: Kernel) -> None:
    params, X, x, generator = _case(kernel)
    w = torch.randn(K, N, S, dtype=torch.float64, generator=generator)
    terms = sum(basis(x) @ own for basis, own in kernel_terms(kernel, params, X, w))
    torch.testing.assert_close(terms, kernel.covariance(params, x, X) @ w, rtol=SAME, atol=SAME)


@kernels
def test_terms_of_random_features_are_the_same_functions(kernel: Kernel) -> None:
    params, _, x, generator = _case(kernel)
    draw = kernel.draw(params, x, 64, generator)
    w = torch.randn(K, draw.basis(x).shape[-1], S, dtype=torch.float64, generator=generator)
    terms = sum(basis(x) @ own for basis, own in draw.weighted(w))
    torch.testing.assert_close(terms, draw.basis(x) @ w, rtol=SAME, atol=SAME)


def test_inputs_of_each_component_give_the_same_functions() -> None:
    kernel, generator = Linear(shared=True, offset=0.3), torch.Generator().manual_seed(0)
    params = kernel.initial(K, {"qd": 2})
    x = {"qd": torch.randn(N, K, 2, dtype=torch.float64, generator=generator)}
    draw = kernel.draw(params, x, 64, generator)
    w = torch.randn(K, draw.basis(x).shape[-1], S, dtype=torch.float64, generator=generator)
    terms = sum(basis(x) @ own for basis, own in draw.weighted(w))
    torch.testing.assert_close(terms, draw.basis(x) @ w, rtol=SAME, atol=SAME)


@pytest.mark.parametrize(
    "kernel", [Linear(shared=True), Linear(shared=True) * SquaredExponential(shared=True)]
)
def test_terms_take_inputs_of_each_component(kernel: Kernel) -> None:
    params, generator = kernel.initial(K, {"qd": 2}), torch.Generator().manual_seed(0)
    X, x = ({"qd": torch.randn(n, K, 2, dtype=torch.float64, generator=generator)} for n in (N, 7))
    w = torch.randn(K, N, S, dtype=torch.float64, generator=generator)
    terms = sum(basis(x) @ own for basis, own in kernel_terms(kernel, params, X, w))
    torch.testing.assert_close(terms, kernel.covariance(params, x, X) @ w, rtol=SAME, atol=SAME)
