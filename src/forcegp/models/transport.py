"""Fitted models through process pools and `copy.deepcopy`, as the bytes of their saved form.

No attribute of a model travels: what arrives in another process was read and checked as a saved model is.
"""

from __future__ import annotations

import copyreg
from typing import Any

from forcegp.models.analytical import AnalyticalFit
from forcegp.models.base import FittedModel
from forcegp.models.independent_gp import IndependentFit
from forcegp.models.load import model_of_bytes
from forcegp.models.neural import NetworkFit
from forcegp.models.structured_fit import StructuredFit
from forcegp.storage.model_file import model_bytes

KINDS = (AnalyticalFit, NetworkFit, IndependentFit, StructuredFit)
"""Fitted models."""


def register() -> None:
    """Let the copying and sending of models go through their saved form."""
    for kind in KINDS:
        copyreg.pickle(kind, _sent)  # pyright: ignore[reportArgumentType]


def _sent(model: FittedModel) -> tuple[Any, ...]:
    """How a model is made again: from the content of its file.

    Raises:
        ModelError: a part of the model is Python code.
    """
    return model_of_bytes, (model_bytes(model.kind, model.system, *model.record()),)
