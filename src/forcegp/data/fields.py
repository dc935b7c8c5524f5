"""The fields of a data set, as its checks and its files see them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from forcegp.data.header import DataHeader
from forcegp.errors import DataError

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


def contact_table(data: Fields, contacts: Sequence[str]) -> Tensor:
    """`(n, len(contacts))` bool: which of the named contacts are closed."""
    for name in contacts:
        if name not in data.contact:
            raise DataError(
                f"column 'contact.{name}' is missing",
                expected=f"contact.{name}, 1 where the contact is closed and 0 elsewhere",
                got=", ".join(f"contact.{c}" for c in data.contact) or "no contact column",
            )
    columns_ = [data.contact[name] for name in contacts]
    return torch.stack(columns_, dim=-1) if columns_ else data.segment.new_zeros(len(data), 0).bool()
