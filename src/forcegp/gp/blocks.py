"""Samples of blocks: some of them, a chunk at a time, their numbers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from torch import Tensor

from forcegp.gp.features import Features
from forcegp.gp.structured_covariance import Block


def points(features: Features) -> int:
    """Number of inputs in a dictionary of features."""
    return len(next(iter(features.values())))


def components_of(block: Block) -> list[int]:
    """Number of components of each process."""
    return [W.shape[-1] for W in block.operators]


def chunked(blocks: Iterable[Block], samples: int) -> Iterator[Block]:
    """The samples of blocks in blocks of at most so many."""
    for block in blocks:
        for first in range(0, len(block.target), samples):
            yield rows_of(block, slice(first, first + samples))


def rows_of(block: Block, own: slice | Tensor) -> Block:
    """Some of the samples of a block."""
    return Block(
        tuple({name: x[own] for name, x in f.items()} for f in block.features),
        tuple(W[own] for W in block.operators),
        block.target[own],
    )
