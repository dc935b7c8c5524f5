"""What every tensor in a saved model must be, checked once, when the file is read."""

from __future__ import annotations

import re
from collections.abc import Mapping

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.limits import TENSORS
from forcegp.storage.system import MAY_BE_INFINITE

TYPES = (torch.float64, torch.float32, torch.int64, torch.bool)
"""Types of tensors that a model holds."""

_MAY_BE_INFINITE = re.compile(rf"(system|start)\.({'|'.join(MAY_BE_INFINITE)})")
_POSITIVE = re.compile(r"(data\.\d+|training)\.noise_std|std\.[^.]+|scale\..+\.std\.[^.]+")
"""Standard deviations: of the noise, and those that inputs are divided by."""


def check_tensors(tensors: Mapping[str, Tensor], source: str) -> None:
    """Check the number, types and values of tensors that were read.

    Only joint limits may be infinite, nothing may be NaN, and standard deviations are positive. Which
    tensors a model has, and their shapes, its loader checks.

    Args:
        tensors: by name.
        source: name of the file, for messages.

    Raises:
        ModelError: a tensor is of another type, not finite, or not positive where it must be.
    """
    if len(tensors) > TENSORS:
        raise ModelError(f"{source}: too many tensors", expected=f"at most {TENSORS}", got=len(tensors))
    for name, value in tensors.items():
        if value.dtype not in TYPES:
            raise ModelError(
                f"{source}: tensor {name!r} has a type that no model has",
                expected=", ".join(str(dtype) for dtype in TYPES),
                got=value.dtype,
            )
        infinite = _MAY_BE_INFINITE.fullmatch(name) is not None
        if bool(value.isnan().any()) or not (infinite or bool(torch.isfinite(value).all())):
            raise ModelError(f"{source}: tensor {name!r} holds values that are not finite")
        if _POSITIVE.fullmatch(name) and not bool((value > 0.0).all()):
            raise ModelError(
                f"{source}: tensor {name!r} holds a standard deviation that is not positive",
                got=value.min().item(),
            )
