"""Functions drawn from the sparse posterior have its mean and covariance."""

from __future__ import annotations

import torch

from gp.sparse_cases import PROCESSES, condition_sparse, first, latent_covariance, parameters, rows

COUNT, FEATURES = 4000, 2000
STANDARD_ERRORS = 5.0
"""Of a mean over `COUNT` draws; sixty comparisons are made."""
COVARIANCE = 0.12
"""Relative: about 4/√COUNT by sampling and 2/√FEATURES by the random features."""


def test_mean_and_covariance_are_those_of_the_posterior() -> None:
    block, test = rows(30), rows(5, seed=2)
    posterior = condition_sparse(PROCESSES, parameters(), [block], first(block, 10))
    samples = posterior.draw(COUNT, torch.Generator().manual_seed(0), FEATURES)
    assert samples.count == COUNT
    drawn = torch.cat([samples.latent(p, f) for p, f in enumerate(test.features)], dim=-1)
    mean = torch.cat([posterior.latent_mean(p, f) for p, f in enumerate(test.features)], dim=-1)
    covariance = latent_covariance(posterior, test)
    std = covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert bool(((drawn.mean(0) - mean).abs() < STANDARD_ERRORS * std / COUNT**0.5).all())
    centred = drawn - drawn.mean(0)
    got = torch.einsum("snk,snl->nkl", centred, centred) / COUNT
    scale = std[:, :, None] * std[:, None, :]
    assert float(((got - covariance) / scale).abs().max()) < COVARIANCE


def test_one_sample_per_state_is_that_sample() -> None:
    block, test = rows(30), rows(5, seed=2)
    posterior = condition_sparse(PROCESSES, parameters(), [block], first(block, 10))
    samples = posterior.draw(7, torch.Generator().manual_seed(0), 64)
    which = [6, 0, 3, 3, 1]
    for p, features in enumerate(test.features):
        every = samples.latent(p, features)
        for i, s in enumerate(which):
            own = samples.by_runs(p, {name: x[i : i + 1] for name, x in features.items()}, range(s, s + 1), 1)
            assert torch.allclose(own[0], every[s, i], rtol=1e-12, atol=1e-12)
