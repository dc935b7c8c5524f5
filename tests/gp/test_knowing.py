"""Posteriors given the value of a constant process, against the dense formula with it as an exact row."""

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
VALUE = torch.tensor([0.7, -1.2, 0.4], dtype=torch.float64)


@dataclass(frozen=True)
class Process:
    kernel: Kernel
    prefix: str


PROCESSES = (Process(SquaredExponential(("x",), shared=True), "smooth"), Process(Constant(), "fixed"))


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


def dense_mean(data: Block, test: Block, params: dict[str, Tensor]) -> Tensor:
    """E[W_* f | y, f_p = c]: the rows of the data and of f_p together, the latter without noise."""

    def covariance(a: Block, b: Block) -> Tensor:
        total = torch.zeros(a.rows, b.rows, dtype=torch.float64)
        for p, process in enumerate(PROCESSES):
            own = {k.split(".")[1]: v for k, v in params.items() if k.startswith(process.prefix)}
            k = process.kernel.covariance(own, a.features[p], b.features[p])
            product = torch.einsum("nak,knm,mbk->namb", a.operators[p], k, b.operators[p])
            total += product.reshape(a.rows, b.rows)
        return total

    one = torch.zeros(1, 1, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)[None]
    known = Block(({"x": one}, {"one": one}), (torch.zeros(1, 3, 2, dtype=torch.float64), eye), VALUE[None])
    parts = (data, known)
    K = torch.cat([torch.cat([covariance(a, b) for b in parts], dim=1) for a in parts])
    noise = torch.cat([torch.ones(data.rows), torch.zeros(3)]).double()
    y = torch.cat([data.target.reshape(-1), VALUE])
    # What the constant process explains counts as part of the prior mean of the test rows.
    own = Block(test.features, (test.operators[0], torch.zeros_like(test.operators[1])), test.target)
    cross = torch.cat([covariance(own, b) for b in parts], dim=1)
    return (cross @ torch.linalg.solve(K + torch.diag(noise), y)).reshape(test.target.shape)


@pytest.mark.parametrize("kind", ["exact", "sparse"])
def test_means_given_a_value_are_those_of_the_dense_formula(kind: str) -> None:
    data, test, params = rows(25, 0), rows(6, 1), parameters()
    if kind == "exact":
        posterior = ExactPosterior.of(PROCESSES, params, [data])
    else:
        Z = ({"x": data.features[0]["x"]}, {"one": data.features[1]["one"][:0]})
        basis = latent_basis(PROCESSES, params, Z, COMPONENTS)
        posterior = SparsePosterior.of(basis, accumulate(basis, [data]))
    given = posterior.knowing(1, {"one": torch.zeros(1, 1, dtype=torch.float64)}, VALUE)
    expected = dense_mean(data, test, params)
    torch.testing.assert_close(given.mean(test), expected, rtol=1e-7, atol=1e-8)
    assert not torch.allclose(posterior.mean(test), expected, rtol=1e-2)
    assert not given.latent_mean(1, test.features[1]).any()
