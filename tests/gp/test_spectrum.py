"""The truncated root of an inverse against NumPy."""

from __future__ import annotations

import numpy as np
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
