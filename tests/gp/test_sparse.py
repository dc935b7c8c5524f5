"""The sparse posterior against dense textbook formulas, the exact posterior, and refits."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from extended import is_extended
from extended import posterior as dense
from forcegp.errors import ModelError, NumericalError
from forcegp.gp.basis import latent_basis
from forcegp.gp.features import Block, rows_of
from forcegp.gp.kernels import Linear, sub
from forcegp.gp.likelihood import condition, cross_gram
from forcegp.gp.sparse import SparsePosterior
from forcegp.gp.sums import accumulate
from gp.sparse_cases import (
    COMPONENTS,
    PROCESSES,
    Named,
    condition_sparse,
    first,
    latent_covariance,
    parameters,
    rows,
    textbook,
)

ALGEBRA = 1e-8
"""Two orders of summation and factorisation of matrices with condition numbers up to about 10⁶."""
ROUNDING = 1e-10


def fitted(
    blocks: list[Block], inducing: list[dict[str, Tensor]] | None = None
) -> tuple[SparsePosterior, dict[str, Tensor]]:
    params = parameters()
    Z = inducing if inducing is not None else first(blocks[0], 12)
    return condition_sparse(PROCESSES, params, blocks, Z), params


def mean_of(posterior: SparsePosterior, block: Block) -> Tensor:
    """Posterior mean of rows `(n, d)`."""
    latent = [posterior.latent_mean(p, features) for p, features in enumerate(block.features)]
    return sum(
        ((W @ f[..., None])[..., 0] for W, f in zip(block.operators, latent, strict=True)),
        start=torch.zeros_like(block.target),
    )


def test_equals_the_dense_textbook_sparse_posterior() -> None:
    blocks, test = [rows(30), rows(21, r=2, seed=1)], rows(9, r=4, seed=2)
    Z = first(rows(12, seed=5), 12)
    posterior, params = fitted(blocks, Z)
    mean, covariance = textbook(blocks, Z, params).predict(test)
    assert np.abs(mean_of(posterior, test).numpy() - mean).max() < ALGEBRA
    assert np.abs(posterior.covariance(test).numpy() - covariance).max() < ALGEBRA
    assert posterior.jitter == 0.0


def test_equals_the_exact_posterior_where_inducing_points_are_the_data() -> None:
    blocks, test = [rows(25), rows(15, r=2, seed=1)], rows(9, r=4, seed=2)
    Z = [
        {name: torch.cat([block.features[p][name] for block in blocks]) for name in ("q", "qd")}
        for p in range(2)
    ]
    posterior, params = fitted(blocks, Z)
    exact = condition(PROCESSES, params, blocks)
    cross = cross_gram(PROCESSES, params, blocks, [test])
    mean = (cross.mT @ exact.alpha).reshape(test.target.shape)
    V = torch.linalg.solve_triangular(exact.L, cross, upper=False)
    prior = cross_gram(PROCESSES, params, [test], [test])
    full = (prior - V.mT @ V).unflatten(0, test.target.shape).unflatten(2, test.target.shape)
    covariance = torch.stack([full[i, :, i] for i in range(len(test.target))])
    assert torch.allclose(mean_of(posterior, test), mean, atol=1e-6, rtol=0)
    assert torch.allclose(posterior.covariance(test), covariance, atol=1e-6, rtol=0)


@pytest.mark.skipif(not is_extended(), reason="numpy.longdouble is no more than float64 here")
@pytest.mark.parametrize("stronger", [0.0, 1.5, 3.0, 4.0, 6.0])
def test_a_strong_prior_leaves_right_variances_or_is_refused(stronger: float) -> None:
    """Long length-scales and a force up to e¹² times the noise, where the missed variance is a difference."""
    block, params = rows(25), parameters()
    params = {k: v + stronger * (k.endswith("std") + 0.3 * k.endswith("scale")) for k, v in params.items()}
    test = rows_of(block, slice(10))
    _, _, exact = dense(PROCESSES, params, [block], test)
    found = condition_sparse(PROCESSES, params, [block], first(block, 25))
    assert float(found.moments.missed.min()) >= 0.0
    try:
        found.require_resolved()
        variance = found.covariance(test).diagonal(dim1=-2, dim2=-1).numpy()
    except NumericalError:
        assert stronger == 6.0
    else:
        assert np.abs(np.sqrt(variance / exact) - 1.0).max() < 0.01


def test_a_process_that_no_row_shows_keeps_its_prior_and_needs_no_points() -> None:
    shown, params = rows(20), parameters()
    hidden = Block(shown.features, (shown.operators[0], torch.zeros_like(shown.operators[1])), shown.target)
    Z = first(shown, 8)
    posterior = condition_sparse(PROCESSES, params, [hidden], [Z[0], {k: x[:0] for k, x in Z[1].items()}])
    assert posterior.measured == (True, False)
    test = rows(6, seed=2)
    assert torch.equal(posterior.latent_mean(1, test.features[1]), torch.zeros(6, 1, dtype=torch.float64))
    latent = latent_covariance(posterior, test)
    prior = PROCESSES[1].kernel.diagonal(sub(params, "contact"), test.features[1])[0]
    assert torch.allclose(latent[:, 2, 2], prior, rtol=ROUNDING)
    assert float(latent[:, 2, :2].abs().max()) == 0.0


def test_chunks_and_shards_make_no_difference() -> None:
    block, params = rows(70), parameters()
    basis = latent_basis(PROCESSES, params, first(block, 12), COMPONENTS)
    whole = accumulate(basis, [block])
    halves = accumulate(basis, [rows_of(block, slice(0, 33))]) + accumulate(
        basis, [rows_of(block, slice(33, None))]
    )
    chunked = accumulate(basis, (b for b in [block]), chunk=7)
    for other in (halves, chunked):
        for a, b in zip(whole.tensors, other.tensors, strict=True):
            assert torch.allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("new", [1, 5, 40])
def test_update_equals_refit(new: int) -> None:
    old, more = rows(60), rows(new, seed=7)
    Z = first(old, 12)
    before, params = fitted([old], Z)
    updated, refit = before.updated([more]), condition_sparse(PROCESSES, params, [old, more], Z)
    test = rows(9, seed=2)
    assert torch.allclose(mean_of(updated, test), mean_of(refit, test), atol=ALGEBRA, rtol=0)
    assert torch.allclose(updated.covariance(test), refit.covariance(test), atol=ALGEBRA, rtol=0)
    assert float(updated.sums.rows) == 3 * (60 + new)
    assert torch.allclose(updated.sums.missed, refit.sums.missed, rtol=ROUNDING)


def test_a_window_is_removed() -> None:
    old, more = rows(60), rows(20, seed=7)
    Z = first(old, 12)
    kept, _ = fitted([old], Z)
    both, _ = fitted([old, more], Z)
    test = rows(9, seed=2)
    moved = both.without([more])
    assert torch.allclose(mean_of(moved, test), mean_of(kept, test), atol=ALGEBRA, rtol=0)
    assert torch.allclose(moved.covariance(test), kept.covariance(test), atol=ALGEBRA, rtol=0)
    with pytest.raises(ModelError, match="cannot remove more rows"):
        kept.without([old, more])
    with pytest.raises(NumericalError, match="not positive definite"):
        kept.without([Block(more.features, tuple(9.0 * W for W in more.operators), more.target)])


def test_forgetting_is_louder_noise_on_what_came_before() -> None:
    """A sample that counts g times is one whose noise variance is 1/g times as large."""
    old, g = rows(60), 0.3
    Z, params = first(old, 12), parameters()
    quiet = Block(old.features, tuple(g**0.5 * W for W in old.operators), g**0.5 * old.target)
    forgetting = condition_sparse(PROCESSES, params, [old], Z).forgetting(g)
    louder = condition_sparse(PROCESSES, params, [quiet], Z)
    test = rows(9, seed=2)
    assert torch.allclose(mean_of(forgetting, test), mean_of(louder, test), atol=ALGEBRA, rtol=0)
    assert torch.allclose(forgetting.covariance(test), louder.covariance(test), atol=ALGEBRA, rtol=0)
    with pytest.raises(ModelError, match="between 0 and 1"):
        forgetting.forgetting(1.5)


def test_large_scales_lose_no_digits() -> None:
    """Against orthogonal factorisation of all rows, where those of one sample weigh 10⁵ noise deviations."""
    block, test = rows(400), rows(9, seed=2)
    sharp = Block(block.features, tuple(1e5 * W for W in block.operators), 1e5 * block.target)
    posterior, _ = fitted([sharp], first(block, 40))
    Phi = by_rows(posterior, sharp)
    stacked = np.concatenate([Phi, np.eye(Phi.shape[1])])
    target = np.concatenate([sharp.target.numpy().reshape(-1), np.zeros(Phi.shape[1])])
    Q, R = np.linalg.qr(stacked)
    own = by_rows(posterior, test)
    mean = (own @ np.linalg.solve(R, Q.T @ target)).reshape(9, 3)
    half = np.linalg.solve(R.T, own.T).T.reshape(9, 3, -1)
    parts = zip(posterior.basis.parts, test.features, strict=True)
    missed = torch.cat([part.missed(part.rest_variance(x), part.values(x)[1]) for part, x in parts]).mT
    W = torch.cat(test.operators, dim=-1).numpy()
    covariance = half @ half.transpose(0, 2, 1) + np.einsum("nak,nk,nbk->nab", W, missed.numpy(), W)
    assert posterior.jitter == 0.0
    assert np.abs(mean_of(posterior, test).numpy() - mean).max() < ALGEBRA
    assert np.abs(posterior.covariance(test).numpy() - covariance).max() < ALGEBRA


def by_rows(posterior: SparsePosterior, block: Block) -> np.ndarray:
    """W_i V_iᵀ of all rows, a component at a time."""
    rows = []
    for part, W, x in zip(posterior.basis.parts, block.operators, block.features, strict=True):
        for k, V in enumerate(part.values(x)[0]):
            rows.append(W[:, :, k, None] * V[:, None, part.used[k]])
    return torch.cat(rows, dim=-1).flatten(0, 1).numpy()


def test_processes_with_one_operator_are_summed_together() -> None:
    """Against all rows, where two processes share an operator, one is padded, and blocks alternate."""
    few = Named(Linear(("q",)), "few")
    processes, one = (PROCESSES[0], few, PROCESSES[0]), rows(40)
    params = parameters() | {f"few.{k}": v for k, v in few.kernel.initial(2, {"q": 2, "qd": 2}).items()}
    W, other = one.operators
    x, y = one.features
    shared = Block((x, y, y), (W, W, other.expand(-1, -1, 2)), one.target)
    apart = Block((x, y, y), (W, 2.0 * W, torch.zeros_like(W)), one.target)
    for key in (key for key in params if "lengthscale" in key):
        params[key][..., -1, :] += 9.0
    basis = latent_basis(processes, params, first(shared, 12), (2, 2, 2))
    blocks = [shared, apart, shared]
    Phi = np.concatenate([basis.rows(block).numpy() for block in blocks])
    sums = accumulate(basis, blocks, chunk=16)
    target = torch.cat([block.target.flatten() for block in blocks]).numpy()
    assert not all(bool(part.used.all()) for part in basis.parts)
    assert np.abs(sums.G.numpy() - Phi.T @ Phi).max() < ROUNDING * np.abs(Phi.T @ Phi).max()
    assert np.abs(sums.v.numpy() - Phi.T @ target).max() < ROUNDING * np.abs(Phi.T @ target).max()


def test_sums_of_different_bases_do_not_add() -> None:
    block, params = rows(20), parameters()
    one = accumulate(latent_basis(PROCESSES, params, first(block, 5), COMPONENTS), [block])
    two = accumulate(latent_basis(PROCESSES, params, first(block, 6), COMPONENTS), [block])
    with pytest.raises(ModelError, match="different bases"):
        one + two


def test_diagnostics_tell_when_more_points_would_help() -> None:
    block = rows(200)
    few, _ = fitted([block], first(block, 2))
    many, _ = fitted([block], first(block, 200))
    assert few.diagnostics.more_points_would_help and not many.diagnostics.more_points_would_help
    assert few.diagnostics.missed == pytest.approx(float(few.sums.missed.sum()))
    Phi = by_rows(many, block)
    A = np.eye(Phi.shape[1]) + Phi.T @ Phi
    smoother = Phi @ np.linalg.solve(A, Phi.T)
    assert many.diagnostics.learned == pytest.approx(np.trace(smoother), rel=1e-6)


def test_bound_follows_updates() -> None:
    old, more = rows(30), rows(4, r=2, seed=1)
    Z = first(rows(12, seed=5), 12)
    posterior, params = fitted([old], Z)
    dense = textbook([old, more], Z, params).negative_bound()
    updated = posterior.updated([more])
    assert -updated.log_likelihood == pytest.approx(dense, rel=1e-9)


def test_a_wide_prior_of_an_exact_feature_is_resolved() -> None:
    """The variance of a weight w ~ N(0, s²) seen through n rows of unit noise is 1/(1/s² + Σ φ²)."""
    process, s, n = Named(Linear(("q",)), "wide"), 1e8, 30
    generator = torch.Generator().manual_seed(0)
    phi = torch.randn(n, 1, generator=generator, dtype=torch.float64)
    params = {"wide.log_slope_std": torch.full((1, 1), math.log(s), dtype=torch.float64)}
    params["wide.log_bias_std"] = torch.full((1,), -50.0, dtype=torch.float64)
    block = Block(({"q": phi},), (torch.ones(n, 1, 1, dtype=torch.float64),), phi)
    found = condition_sparse([process], params, [block], [{"q": phi[:0]}]).covariance(block)[:, 0, 0]
    exact = phi[:, 0].square() / (s**-2 + float(phi.square().sum()))
    torch.testing.assert_close(found, exact, rtol=1e-12, atol=0.0)
