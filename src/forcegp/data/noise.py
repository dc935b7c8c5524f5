"""Measurement noise on logged accelerations."""

from __future__ import annotations

import torch

from forcegp.data.dataset import Dataset
from forcegp.errors import DataError


def with_noise(data: Dataset, std: float, generator: torch.Generator) -> Dataset:
    """Gaussian noise on q̈, beside the noise-free value: q̈ = q̈_clean + std ε, ε ~ N(0, I).

    Where the data hold `qdd_clean`, the noise is added to that, so that it never adds up.

    Args:
        data: the log.
        std: standard deviation [rad/s², m/s²].
        generator: source of the random numbers; its seed is recorded in the header.

    Raises:
        DataError: the standard deviation is negative or not finite.
    """
    if not 0.0 <= std < float("inf"):
        raise DataError("the noise is not valid", expected="a finite standard deviation ≥ 0", got=std)
    clean = data.extras.get("qdd_clean", data.qdd)
    noise = torch.randn(clean.shape, dtype=clean.dtype, device=generator.device, generator=generator)
    header = data.header.with_step(
        f"noise of standard deviation {std:g} on qdd, seed {generator.initial_seed()}",
        noise_std=std,
        filtered=False,
        filter_span=None,
    )
    return data.replace(
        qdd=clean + std * noise.to(clean.device), extras={**data.extras, "qdd_clean": clean}, header=header
    )
