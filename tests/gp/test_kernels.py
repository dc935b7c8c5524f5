"""Kernels against the formulas written down, one contract for all of them."""

from __future__ import annotations

import math
import time

import pytest
import torch
from torch import Tensor

from forcegp.errors import ModelError, UnknownNameError
from forcegp.gp.kernels import (
    Kernel,
    Linear,
    Matern32,
    Matern52,
    Product,
    SquaredExponential,
    Stationary,
    Sum,
)

WIDTHS = {"q": 3, "qd": 2}
OUTPUTS = 2
ROUNDING = 1e-12
DRAWS = 20_000
"""Random features; their covariance errs by about 1/√DRAWS of the variance."""

SE, M32, M52, LIN = SquaredExponential(), Matern32(), Matern52(), Linear()
KERNELS: dict[str, Kernel] = {
    "squared exponential": SE,
    "shared length-scales": SquaredExponential(shared=True),
    "matern 3/2": M32,
    "matern 5/2": M52,
    "linear": LIN,
    "linear with one slope": Linear(ard=False),
    "linear with shared slopes": Linear(shared=True),
    "linear with an offset": Linear(ard=False, offset=0.3),
    "shared slopes with an offset": Linear(shared=True, offset=0.3),
    "damping": Linear(("qd",), ard=False) * SquaredExponential(("q",)),
    "quadratic": Linear(("qd",), shared=True) * Linear(("qd",), shared=True) * SquaredExponential(("q",)),
    "of one input": SquaredExponential(("qd",)),
    "sum": SE + LIN,
    "product": SquaredExponential(("q",)) * Matern52(("qd",)),
    "shared in a product": Linear(("qd",), ard=False) * Matern52(("q",), shared=True),
    "nested": (Linear(("q",)) + Matern32()) * SquaredExponential(("qd",)),
}
kernels = pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS.keys())


def random_parameters(kernel: Kernel, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    initial = kernel.initial(OUTPUTS, WIDTHS)
    return {
        k: v + 0.3 * torch.randn(v.shape, generator=generator, dtype=torch.float64)
        for k, v in initial.items()
    }


def inputs(n: int, seed: int = 0, scale: float = 1.0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {k: scale * torch.randn(n, w, generator=generator, dtype=torch.float64) for k, w in WIDTHS.items()}


def by_hand(kernel: Kernel, params: dict[str, Tensor], x1: dict, x2: dict, k: int, i: int, j: int) -> float:
    """One entry with scalars."""
    parts = {
        side: {n[len(side) + 1 :]: v for n, v in params.items() if n.startswith(side)}
        for side in ("left", "right")
    }
    if isinstance(kernel, Sum | Product):
        left = by_hand(kernel.left, parts["left"], x1, x2, k, i, j)
        right = by_hand(kernel.right, parts["right"], x1, x2, k, i, j)
        return left * right if isinstance(kernel, Product) else left + right
    assert isinstance(kernel, Linear | Stationary)
    names = kernel.inputs or tuple(x1)
    a = [float(v) for n in names for v in x1[n][i]]
    b = [float(v) for n in names for v in x2[n][j]]
    if isinstance(kernel, Linear):
        given = params["log_slope_std"][0 if kernel.shared else k]
        size = math.exp(float(params["log_std"][k])) ** 2 if kernel.shared else 1.0
        slopes = [size * math.exp(float(v)) ** 2 for v in given.expand(len(a))]
        if kernel.offset is None:
            bias = math.exp(float(params["log_bias_std"][k])) ** 2
        else:
            bias = math.exp(float(params["log_offset"])) ** 2 * sum(slopes) / len(slopes)
        return bias + sum(s * p * q for s, p, q in zip(slopes, a, b, strict=True))
    lengths = [math.exp(float(v)) for v in params["log_lengthscale"][0 if kernel.shared else k]]
    r = math.sqrt(sum(((p - q) / s) ** 2 for p, q, s in zip(a, b, lengths, strict=True)))
    variance = math.exp(float(params["log_std"][k])) ** 2
    profile = {
        SquaredExponential: math.exp(-0.5 * r**2),
        Matern32: (1 + math.sqrt(3) * r) * math.exp(-math.sqrt(3) * r),
        Matern52: (1 + math.sqrt(5) * r + 5 * r**2 / 3) * math.exp(-math.sqrt(5) * r),
    }
    return variance * profile[type(kernel)]


@kernels
def test_entries_are_the_formula(kernel: Kernel) -> None:
    params, x1, x2 = random_parameters(kernel), inputs(4), inputs(3, seed=1)
    K = kernel.covariance(params, x1, x2)
    assert K.shape == (OUTPUTS, 4, 3)
    for k in range(OUTPUTS):
        for i in range(4):
            for j in range(3):
                assert float(K[k, i, j]) == pytest.approx(
                    by_hand(kernel, params, x1, x2, k, i, j), rel=ROUNDING
                )


@kernels
def test_symmetric_positive_and_with_the_diagonal_it_says(kernel: Kernel) -> None:
    params, x = random_parameters(kernel), inputs(40)
    K = kernel.covariance(params, x, x)
    assert torch.allclose(K, K.mT, rtol=ROUNDING, atol=ROUNDING)
    assert torch.allclose(K.diagonal(dim1=1, dim2=2), kernel.diagonal(params, x), rtol=1e-10)
    eigenvalues = torch.linalg.eigvalsh(K)
    assert float(eigenvalues.min()) > -1e-12 * float(eigenvalues.max())


@kernels
def test_gradients_are_central_differences(kernel: Kernel) -> None:
    """To hyperparameters and inputs, coincident inputs among them."""
    params, x1 = random_parameters(kernel), inputs(5)
    x2 = {n: torch.cat([x[:2], x[3:] + 0.7]) for n, x in x1.items()}
    weights = torch.randn(OUTPUTS, 5, 4, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    tensors = {**params, **x1}

    def value(tensors: dict[str, Tensor]) -> Tensor:
        k = kernel.covariance({n: tensors[n] for n in params}, {n: tensors[n] for n in x1}, x2)
        return (weights * k).sum()

    leaves = {n: x.clone().requires_grad_() for n, x in tensors.items()}
    found = dict(
        zip(leaves, torch.autograd.grad(value(leaves), list(leaves.values()), allow_unused=True), strict=True)
    )
    h = 1e-6
    for n, x in tensors.items():
        direction = torch.randn(x.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
        ahead, behind = ({**tensors, n: x + s * h * direction} for s in (1.0, -1.0))
        difference = float(value(ahead) - value(behind)) / (2 * h)
        ours = 0.0 if found[n] is None else float((found[n] * direction).sum())
        # A Matérn kernel of degree 3/2 has a kink in its second derivative where inputs coincide.
        assert ours == pytest.approx(difference, rel=1e-5, abs=1e-5), n


@pytest.mark.parametrize("kernel", [SE, M32, M52], ids=["se", "matern32", "matern52"])
def test_coincident_inputs_have_finite_values_and_gradients(kernel: Kernel) -> None:
    params = {n: v.requires_grad_() for n, v in random_parameters(kernel).items()}
    x = {n: v[:1].expand(6, -1).clone().requires_grad_() for n, v in inputs(1).items()}
    K = kernel.covariance(params, x, x)
    variance = torch.exp(2.0 * params["log_std"])[:, None, None]
    assert torch.allclose(K, variance.expand_as(K), rtol=1e-12)
    for gradient in torch.autograd.grad(K.sum(), [params["log_lengthscale"], *x.values()]):
        assert float(gradient.abs().max()) < 1e-6


@pytest.mark.parametrize("kernel", [SE, M32, M52], ids=["se", "matern32", "matern52"])
def test_far_apart_inputs_give_no_denormal_numbers(kernel: Kernel) -> None:
    """exp of minus a few hundred to a few thousand underflows gradually, which slows processors down."""
    params, smallest = kernel.initial(1, WIDTHS), torch.finfo(torch.float64).tiny
    far = inputs(200, scale=30.0)
    K = kernel.covariance(params, far, far)
    assert not bool(((K.abs() > 0.0) & (K.abs() < smallest)).any())
    products = 1e-3 * K * K.mT
    assert not bool(((products.abs() > 0.0) & (products.abs() < smallest)).any())

    def seconds(x: dict[str, Tensor]) -> float:
        A = kernel.covariance(params, x, x)[0]
        best = math.inf
        for _ in range(5):
            start = time.perf_counter()
            _ = A @ A
            best = min(best, time.perf_counter() - start)
        return best

    assert seconds(far) < 5.0 * seconds(inputs(200)), "denormal numbers cost a factor of 70"


@kernels
def test_random_features_have_the_kernel_as_covariance(kernel: Kernel) -> None:
    params, x = random_parameters(kernel), inputs(4, scale=0.7)
    basis = kernel.draw(params, x, DRAWS, torch.Generator().manual_seed(5)).basis(x)
    assert basis.shape[:2] == (OUTPUTS, 4)
    K = kernel.covariance(params, x, x)
    scale = kernel.diagonal(params, x).amax(-1)[:, None, None]
    chance = 5.0 if isinstance(kernel, Product) else 2.0  # products of features spread more
    assert float(((basis @ basis.mT - K) / scale).abs().max()) < chance * 3.0 / math.sqrt(DRAWS)


def test_a_draw_is_one_function() -> None:
    for kernel in KERNELS.values():
        params, x = random_parameters(kernel), inputs(5)
        one, two = (kernel.draw(params, x, 30, torch.Generator().manual_seed(6)) for _ in range(2))
        assert torch.equal(one.basis(x), two.basis(x))
        part = {n: v[2:4] for n, v in x.items()}
        assert torch.allclose(one.basis(part), one.basis(x)[:, 2:4], rtol=1e-12, atol=1e-12)


def test_inputs_that_are_not_there_are_refused() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown kernel input 'qdd'[\s\S]*did you mean 'qd'"):
        SquaredExponential(("qdd",)).initial(1, WIDTHS)
    with pytest.raises(UnknownNameError, match="unknown kernel input 'tau'"):
        Linear(("tau",)).diagonal(Linear(("tau",)).initial(1, {"tau": 1}), inputs(2))
    with pytest.raises(ModelError, match="a kernel without inputs"):
        SquaredExponential(()).initial(1, WIDTHS)
