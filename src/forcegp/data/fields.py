"""The fields of a data set, as its checks and its files see them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

from torch import Tensor

from forcegp.data.header import DataHeader

JOINT_VECTORS = ("q", "qd", "tau", "qdd")
"""The joint vectors that every data set holds."""
AXES = ("x", "y", "z")
"""Components of a Cartesian vector logged of a contact."""


@runtime_checkable
class Fields(Protocol):
    """What a data set holds; `Dataset` documents each field."""

    @property
    def t(self) -> Tensor: ...
    @property
    def q(self) -> Tensor: ...
    @property
    def joint_names(self) -> tuple[str, ...]: ...
    @property
    def contact(self) -> Mapping[str, Tensor]: ...
    @property
    def extras(self) -> Mapping[str, Tensor]: ...
    @property
    def contact_extras(self) -> Mapping[str, Mapping[str, Tensor]]: ...
    @property
    def segment(self) -> Tensor: ...
    @property
    def header(self) -> DataHeader: ...
    def __len__(self) -> int: ...


def component_names(name: str, value: Tensor, joint_names: Sequence[str]) -> list[str]:
    """Names on disk of the columns of a joint vector, a contact's scalar or its Cartesian vector."""
    if value.ndim == 1:
        return [name]
    return [f"{name}.{part}" for part in (AXES if "." in name else joint_names)]
