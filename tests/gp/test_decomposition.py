"""A kernel is the sum of its finite part, as features, and its rest."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from forcegp.gp.basis import split
from forcegp.gp.kernels import Kernel, Linear, Matern52, SquaredExponential
from gp.sparse_cases import WIDTHS

SE, M52, LIN = SquaredExponential(("q",)), Matern52(("qd",)), Linear(("qd",))
OUTPUTS = 2
CASES: dict[str, tuple[Kernel, int, bool]] = {
    "linear": (LIN, 3, False),
    "stationary": (SE, 0, True),
    "sum": (SE + LIN + Linear(("q",), shared=True), 6, True),
    "product of linear kernels": (LIN * Linear(("q",)), 9, False),
    "damping": (LIN * SE, 0, True),
    "sums multiplied out": ((LIN + SE) * (Linear(("q",)) + M52), 9, True),
    "only one factor linear": ((LIN + SE) * M52, 0, True),
    "nested": (((LIN + SE) * LIN + M52) * LIN, 27, True),
}
cases = pytest.mark.parametrize(("kernel", "features", "has_rest"), CASES.values(), ids=CASES.keys())


def random(kernel: Kernel) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Tensor]]:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    params = {k: v + 0.3 * normal(*v.shape) for k, v in kernel.initial(OUTPUTS, WIDTHS).items()}
    x1, x2 = ({name: normal(n, w) for name, w in WIDTHS.items()} for n in (5, 4))
    return params, x1, x2


@cases
def test_the_parts_add_up_to_the_kernel(kernel: Kernel, features: int, has_rest: bool) -> None:
    params, x1, x2 = random(kernel)
    whole, parts = kernel.covariance(params, x1, x2), split(kernel, params)
    total, diagonal = torch.zeros_like(whole), torch.zeros(OUTPUTS, 5, dtype=torch.float64)
    assert (parts.finite is not None, parts.rest is not None) == (features > 0, has_rest)
    if parts.finite is not None:
        phi = parts.finite.features(x1)
        assert phi.basis(x1).shape == (OUTPUTS, 5, features)
        total = total + phi.basis(x1) @ phi.basis(x2).mT
        diagonal = diagonal + (phi.basis(x1) ** 2).sum(-1)
    if parts.rest is not None:
        total = total + parts.rest.kernel.covariance(parts.rest.params, x1, x2)
        diagonal = diagonal + parts.rest.kernel.diagonal(parts.rest.params, x1)
    assert torch.allclose(total, whole, rtol=1e-12, atol=1e-12)
    assert torch.allclose(diagonal, kernel.diagonal(params, x1), rtol=1e-12, atol=1e-12)


@cases
def test_hyperparameters_reach_the_parts_with_their_gradient(
    kernel: Kernel, features: int, has_rest: bool
) -> None:
    params, x1, x2 = random(kernel)
    leaves = {key: value.requires_grad_() for key, value in params.items()}
    parts = split(kernel, leaves)
    total = torch.zeros(OUTPUTS, 5, 4, dtype=torch.float64)
    if parts.finite is not None:
        phi = parts.finite.features(x1)
        total = total + phi.basis(x1) @ phi.basis(x2).mT
    if parts.rest is not None:
        total = total + parts.rest.kernel.covariance(parts.rest.params, x1, x2)
    got = torch.autograd.grad(total.sin().sum(), list(leaves.values()))
    expected = torch.autograd.grad(kernel.covariance(leaves, x1, x2).sin().sum(), list(leaves.values()))
    for one, other in zip(got, expected, strict=True):
        assert torch.allclose(one, other, rtol=1e-9, atol=1e-9)
