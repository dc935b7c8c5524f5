"""Processes that are errors of zero mean, against the dense formulas with and without them."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from forcegp.gp.basis import latent_basis
from forcegp.gp.exact import ExactPosterior
from forcegp.gp.features import Block
from forcegp.gp.kernels import Constant, Kernel, SquaredExponential
from forcegp.gp.sparse import SparsePosterior
from forcegp.gp.sums import accumulate

COMPONENTS = (2, 3)
DRAWS = 4000


@dataclass(frozen=True)
class Process:
    kernel: Kernel
    prefix: str


PROCESSES = (Process(SquaredExponential(("x",), shared=True), "smooth"), Process(Constant(), "error"))


def rows(n: int, seed: int) -> Block:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(n, 1, generator=generator, dtype=torch.float64)
    operators = tuple(torch.randn(n, 2, k, generator=generator, dtype=torch.float64) for k in COMPONENTS)
    target = torch.randn(n, 2, generator=generator, dtype=torch.float64)
    return Block(({"x": x}, {"one": torch.zeros(n, 1, dtype=torch.float64)}), operators, target)


def parameters() -> dict[str, Tensor]:
    params = {}
    for process, count, width in zip(PROCESSES, COMPONENTS, ({"x": 1}, {"one": 1}), strict=True):
        own = process.kernel.initial(count, width)
        params |= {f"{process.prefix}.{name}": value for name, value in own.items()}
    return params


def covariance(a: Block, b: Block, params: dict[str, Tensor], processes: int) -> Tensor:
    """Σ_p W_a k_p(a, b) W_bᵀ over the first processes."""
    total = torch.zeros(a.rows, b.rows, dtype=torch.float64)
    for p, process in enumerate(PROCESSES[:processes]):
        own = {k.split(".")[1]: v for k, v in params.items() if k.startswith(process.prefix)}
        k = process.kernel.covariance(own, a.features[p], b.features[p])
        product = torch.einsum("nak,knm,mbk->namb", a.operators[p], k, b.operators[p])
        total += product.reshape(a.rows, b.rows)
    return total


def dense(data: Block, test: Block, params: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """The mean of a model without the errors, and the covariance of one with them, of each sample."""
    eye = torch.eye(data.rows, dtype=torch.float64)
    K = covariance(data, data, params, 1) + eye
    mean = covariance(test, data, params, 1) @ torch.linalg.solve(K, data.target.reshape(-1))
    K, cross = covariance(data, data, params, 2) + eye, covariance(test, data, params, 2)
    S = covariance(test, test, params, 2) - cross @ torch.linalg.solve(K, cross.mT)
    n, d = test.target.shape
    return mean.reshape(n, d), torch.stack([S[d * i : d * (i + 1), d * i : d * (i + 1)] for i in range(n)])


def posterior_of(kind: str, data: Block, points: Block) -> ExactPosterior | SparsePosterior:
    params = parameters()
    if kind == "exact":
        return ExactPosterior.of(PROCESSES, params, [data], errors=1)
    Z = ({"x": points.features[0]["x"]}, {"one": points.features[1]["one"][:0]})
    basis = latent_basis(PROCESSES, params, Z, COMPONENTS)
    return SparsePosterior.of(basis, accumulate(basis, [data]), errors=1)


@pytest.mark.parametrize("kind", ["exact", "sparse"])
def test_errors_widen_bars_and_have_no_mean(kind: str) -> None:
    data, test, params = rows(25, 0), rows(6, 1), parameters()
    posterior = posterior_of(kind, data, data)
    mean, S = dense(data, test, params)
    torch.testing.assert_close(posterior.mean(test), mean, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(posterior.covariance(test), S, rtol=1e-7, atol=1e-8)
    assert not posterior.latent_mean(1, test.features[1]).any()
    joint = ExactPosterior.of(PROCESSES, params, [data])
    for p in range(2):
        expected = joint.latent_mean(p, test.features[p])
        torch.testing.assert_close(
            posterior.latent_mean(p, test.features[p], joint=True), expected, rtol=1e-7, atol=1e-8
        )
    assert not torch.allclose(joint.mean(test), mean, rtol=1e-2)
    assert posterior.log_likelihood == pytest.approx(joint.log_likelihood, rel=1e-9)


@pytest.mark.parametrize("kind", ["exact", "sparse"])
def test_more_samples_and_function_samples(kind: str) -> None:
    first, second, test, params = rows(20, 0), rows(5, 2), rows(3, 1), parameters()
    features = first.features, second.features
    whole = Block(
        tuple({k: torch.cat([each[p][k] for each in features]) for k in features[0][p]} for p in range(2)),
        tuple(torch.cat(pair) for pair in zip(first.operators, second.operators, strict=True)),
        torch.cat([first.target, second.target]),
    )  # fmt: skip
    posterior = posterior_of(kind, first, whole).updated([second])
    mean, S = dense(whole, test, params)
    torch.testing.assert_close(posterior.mean(test), mean, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(posterior.covariance(test), S, rtol=1e-7, atol=1e-8)
    drawn = posterior.draw(DRAWS, torch.Generator().manual_seed(0))
    parts = (drawn.latent(p, test.features[p]) for p in range(2))
    values = sum(torch.einsum("nak,snk->sna", W, f) for W, f in zip(test.operators, parts, strict=True))
    assert isinstance(values, Tensor)
    std = S.diagonal(dim1=-2, dim2=-1).sqrt()
    assert float(((values.mean(0) - mean) / std).abs().max()) < 5.0 / DRAWS**0.5
    assert float((values.std(0) / std - 1.0).abs().max()) < 0.1
