"""The truncated root of an inverse, and its derivative, against NumPy and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from forcegp.gp.factor import TRUNCATION, Spectrum


def matrix(values: list[float]) -> Tensor:
    """A symmetric matrix with given eigenvalues."""
    generator = torch.Generator().manual_seed(0)
    n = len(values)
    Q, _ = torch.linalg.qr(torch.randn(n, n, generator=generator, dtype=torch.float64))
    return (Q * torch.tensor(values, dtype=torch.float64)) @ Q.mT


def test_root_is_that_of_the_pseudo_inverse() -> None:
    K = matrix([1e-14, 0.0, 0.3, 1.0, 2.0])
    spectrum = Spectrum.of(K)
    assert spectrum.dropped == 2
    expected = np.linalg.pinv(K.numpy(), rcond=TRUNCATION, hermitian=True)
    assert torch.allclose(spectrum.root @ spectrum.root.mT, torch.from_numpy(expected), rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    "values", [[0.2, 0.5, 1.0, 2.0], [0.0, 0.0, 0.5, 1.0, 2.0]], ids=["full", "truncated"]
)
def test_derivative_is_central_differences(values: list[float]) -> None:
    """Of a function of R Rᵀ; along a direction that keeps the rank where there is one to keep."""
    K = matrix(values)
    generator = torch.Generator().manual_seed(1)
    B, X = (torch.randn(len(K), len(K), generator=generator, dtype=torch.float64) for _ in range(2))

    def value(K: Tensor) -> Tensor:
        root = Spectrum.of(K).root
        return (B * (root @ root.mT)).sum()

    spectrum = Spectrum.of(K)
    root = spectrum.root.clone().requires_grad_()
    (dR,) = torch.autograd.grad((B * (root @ root.mT)).sum(), root)
    step = 1e-6

    def moved(h: float) -> Tensor:
        # A congruence keeps the rank.
        T = torch.eye(len(K), dtype=torch.float64) + h * X
        return T @ K @ T.mT

    expected = float((value(moved(step)) - value(moved(-step))) / (2.0 * step))
    direction = X @ K + K @ X.mT
    assert float((spectrum.pull_back(dR) * direction).sum()) == pytest.approx(expected, rel=1e-6)
