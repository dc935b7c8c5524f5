"""Fitted models through process pools and `copy.deepcopy`, as the bytes of their saved form.

No attribute of a model travels: what arrives in another process was read and checked as a saved model is.
"""

from __future__ import annotations

import copyreg
import tempfile
from pathlib import Path
from typing import Any

from forcegp.models.analytical import AnalyticalFit
from forcegp.models.base import FittedModel
from forcegp.models.independent_gp import IndependentFit
from forcegp.models.load import load_model
from forcegp.models.neural import NetworkFit
from forcegp.models.structured_fit import StructuredFit
from forcegp.storage.folder import HEADER_FILE, TENSOR_FILE

KINDS = (AnalyticalFit, NetworkFit, IndependentFit, StructuredFit)
"""Fitted models."""


def register() -> None:
    """Let the copying and sending of models go through their saved form."""
    for kind in KINDS:
        copyreg.pickle(kind, _sent)  # pyright: ignore[reportArgumentType]


def _sent(model: FittedModel) -> tuple[Any, ...]:
    """How a model is made again: from the content of its two files.

    Raises:
        ModelError: a part of the model is Python code.
    """
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "model"
        model.save(folder)
        return _received, tuple((folder / name).read_bytes() for name in (HEADER_FILE, TENSOR_FILE))


def _received(header: bytes, tensors: bytes) -> FittedModel:
    """The model of the content of its files."""
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "model"
        folder.mkdir()
        (folder / HEADER_FILE).write_bytes(header)
        (folder / TENSOR_FILE).write_bytes(tensors)
        return load_model(folder)
