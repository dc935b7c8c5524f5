"""Models through process pools and `copy.deepcopy`, as the bytes of their saved form.

No attribute of a model travels: what arrives in another process was read and checked as a saved model is.
"""

from __future__ import annotations

import copyreg
import tempfile
from pathlib import Path
from typing import Any

from forcegp.models.analytical import AnalyticalFit, AnalyticalModel
from forcegp.models.base import FittedModel, Model
from forcegp.models.independent_gp import IndependentFit, IndependentGP
from forcegp.models.load import load_model
from forcegp.models.neural import NetworkFit, NeuralNetwork
from forcegp.models.structured_fit import StructuredFit
from forcegp.models.structured_gp import StructuredGP
from forcegp.storage.folder import HEADER_FILE, TENSOR_FILE

KINDS = (
    *(AnalyticalModel, NeuralNetwork, IndependentGP, StructuredGP),
    *(AnalyticalFit, NetworkFit, IndependentFit, StructuredFit),
)
"""Models and their fits."""


def register() -> None:
    """Let the copying and sending of models go through their saved form."""
    for kind in KINDS:
        copyreg.pickle(kind, _sent)  # pyright: ignore[reportArgumentType]


def _sent(model: Model | FittedModel) -> tuple[Any, ...]:
    """How a model is made again: from the content of its two files.

    Raises:
        ModelError: the model has not been fitted, or a part of it is Python code.
    """
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "model"
        model.save(folder)
        content = tuple((folder / name).read_bytes() for name in (HEADER_FILE, TENSOR_FILE))
    return _received, (*content, isinstance(model, FittedModel))


def _received(header: bytes, tensors: bytes, fit: bool) -> Model | FittedModel:
    """The model, or its fit, of the content of its files."""
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "model"
        folder.mkdir()
        (folder / HEADER_FILE).write_bytes(header)
        (folder / TENSOR_FILE).write_bytes(tensors)
        model = load_model(folder)
    return model.fitted if fit else model
