"""Every tensor that a likelihood depends on, by its place, for functions that are differentiable in all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from torch import Tensor

from forcegp.gp.kernels import Parameters
from forcegp.gp.structured_covariance import Block

Place = tuple[Any, ...]
"""("param", name), ("feature", block, process, name), ("operator", block, process) or ("target", block)."""

Gradient = dict[Place, Tensor]
"""Derivatives by place."""


def tensors_of(params: Parameters, blocks: Sequence[Block]) -> Iterator[tuple[Place, Tensor]]:
    """Every tensor that the bound depends on, by its place."""
    for key, value in params.items():
        yield ("param", key), value
    for g, block in enumerate(blocks):
        for p, (features, W) in enumerate(zip(block.features, block.operators, strict=True)):
            for name, x in features.items():
                yield ("feature", g, p, name), x
            yield ("operator", g, p), W
        yield ("target", g), block.target


def from_tensors(named: Mapping[Place, Tensor]) -> tuple[dict[str, Tensor], list[Block]]:
    """Hyperparameters and blocks of the tensors of `tensors_of`."""
    params = {place[1]: x for place, x in named.items() if place[0] == "param"}
    features: dict[int, dict[int, dict[str, Tensor]]] = {}
    operators: dict[int, list[Tensor]] = {}
    for place, x in named.items():
        if place[0] == "feature":
            features.setdefault(place[1], {}).setdefault(place[2], {})[place[3]] = x
        elif place[0] == "operator":
            operators.setdefault(place[1], []).append(x)
    blocks = [
        Block(tuple(features[g][p] for p in range(len(own))), tuple(own), named["target", g])
        for g, own in operators.items()
    ]
    return params, blocks
