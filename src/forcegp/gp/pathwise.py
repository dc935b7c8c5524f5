"""Functions drawn from a posterior, cheap to evaluate anywhere (pathwise conditioning, Wilson et al. 2020).

A function from the prior, made of random features, is corrected by the data. Each sample is one deterministic
function, so a trajectory integrated under it obeys Newton's equation and the constraint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from forcegp.gp.draws import FunctionDraw
from forcegp.gp.features import Features
from forcegp.gp.kernels import Parameters, sub
from forcegp.gp.structured_covariance import Block, Process

FEATURES = 1024
"""Random features per component; the covariance of prior draws errs by about 1/√FEATURES of its scale."""
UNMEASURED = 4
"""A process that no row depends on gets this many times fewer features: no data correct its draws."""

Basis = Callable[[Features], Tensor]
"""x ↦ φ(x) `(components, n, terms)`, or `(1, n, terms)` where all components have the same."""


@dataclass(frozen=True, eq=False)
class FunctionSamples:
    """Samples of latent processes, f_s(x) = Σ_t φ_t(x) w_ts.

    Attributes:
        bases: of each process, functions of its standardized features.
        weights: of each process and basis, `(components, terms, samples)`.
    """

    bases: tuple[tuple[Basis, ...], ...]
    weights: tuple[tuple[Tensor, ...], ...]

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.weights[0][0].shape[-1]

    def latent(self, p: int, features: Features, sample: Tensor | None = None) -> Tensor:
        """Values of process p.

        Args:
            p: index of the process.
            features: its standardized inputs at n states.
            sample: `(n,)` which sample each state belongs to; all samples at all states by default.

        Returns:
            `(samples, n, components)`, or `(n, components)` where `sample` is given.
        """
        terms = [(basis(features), w) for basis, w in zip(self.bases[p], self.weights[p], strict=True)]
        if sample is None:
            return sum((k @ w for k, w in terms[1:]), start=terms[0][0] @ terms[0][1]).permute(2, 1, 0)
        rows = torch.stack([torch.einsum("knj,kjn->nk", k, w[..., sample]) for k, w in terms])
        return rows.sum(0)

    @cached_property
    def _weights_by_sample(self) -> list[list[Tensor]]:
        """By process and basis, `(samples, components, terms)`."""
        return [[w.permute(2, 0, 1).contiguous() for w in own] for own in self.weights]

    def by_runs(self, p: int, features: Features, samples: range, runs: int) -> Tensor:
        """Values of process p from some samples, each at its own runs of states: `(samples · runs,
        components)`."""
        parts = []
        for basis, w in zip(self.bases[p], self._weights_by_sample[p], strict=True):
            phi, own = basis(features).unflatten(1, (len(samples), runs)), w[samples.start : samples.stop]
            if len(phi) == 1:
                parts.append(phi[0] @ own.mT)
            else:
                parts.append(torch.einsum("ksrt,skt->srk", phi, own))
        return sum(parts[1:], start=parts[0]).flatten(0, 1)


@dataclass(frozen=True, eq=False)
class PriorDraws:
    """Functions drawn from the prior.

    Attributes:
        draws: random features of each process.
        weights: of each process, `(components, features, samples)`.
        at_rows: W f(X) at the rows `(rows, samples)`.
    """

    draws: tuple[FunctionDraw, ...]
    weights: tuple[Tensor, ...]
    at_rows: Tensor


def draw_priors(
    processes: Sequence[Process],
    params: Parameters,
    blocks: Sequence[Block],
    measured: Sequence[bool],
    count: int,
    generator: torch.Generator,
    features: int = FEATURES,
) -> PriorDraws:
    """Draw functions from the priors and evaluate them at the rows.

    Args:
        processes, params, blocks: as given to `gram`.
        measured: whether any row depends on each process.
        count: number of functions.
        generator: source of randomness, on the CPU.
        features: random features per component.
    """
    like = blocks[0].target
    draws, weights = [], []
    at_rows = like.new_zeros(sum(block.rows for block in blocks), count)
    for p, process in enumerate(processes):
        own = features if measured[p] else max(1, features // UNMEASURED)
        draw = process.kernel.draw(sub(params, process.prefix), own, generator)
        size = draw.basis(blocks[0].features[p]).shape
        w = torch.randn(size[0], size[2], count, dtype=torch.float64, generator=generator).to(like)
        at_rows += torch.cat(
            [
                torch.einsum("nak,kns->nas", block.operators[p], draw.basis(block.features[p]) @ w).flatten(
                    0, 1
                )
                for block in blocks
            ]
        )
        draws.append(draw)
        weights.append(w)
    return PriorDraws(tuple(draws), tuple(weights), at_rows)
