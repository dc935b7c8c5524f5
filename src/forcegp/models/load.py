"""Reading a saved model of any kind.

Fitted models through process pools and `copy.deepcopy`, as the bytes of their saved form.

No attribute of a model travels: what arrives in another process was read and checked as a saved model is.
"""

from __future__ import annotations

import copyreg
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import UnknownNameError
from forcegp.models.analytical import AnalyticalFit, AnalyticalModel, load_analytical
from forcegp.models.base import FittedModel
from forcegp.models.independent_gp import IndependentFit, IndependentGP, load_independent
from forcegp.models.neural import NetworkFit, NeuralNetwork, load_network
from forcegp.models.structured_fit import StructuredFit
from forcegp.models.structured_gp import StructuredGP
from forcegp.models.structured_load import load_structured
from forcegp.storage.model_file import (
    ModelHeader,
    model_bytes,
    model_path,
    model_tensors,
    parse_model,
    read_model,
)
from forcegp.storage.system import unpack_system

Loader = Callable[[ModelHeader, Mapping[str, Tensor], ConstrainedSystem, str], FittedModel]

LOADERS: dict[str, Loader] = {
    AnalyticalModel.kind: load_analytical,
    NeuralNetwork.kind: load_network,
    IndependentGP.kind: load_independent,
    StructuredGP.kind: load_structured,
}
"""What reads each kind of models."""


def load_model(path: str | Path, *, system: ConstrainedSystem | None = None) -> FittedModel:
    """Read a model that `save` wrote; it predicts the same, bit for bit.

    Args:
        path: the file; `.safetensors` is added if it is left out.
        system: where to take constraints from that only Python code describes (an `ImplicitSurface`);
            robot and other constraints are those in the file.

    Example:
        >>> import forcegp, torch
        >>> system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
        >>> q, qd, tau = torch.randn(3, 20, 2, dtype=torch.float64)
        >>> qdd = forcegp.dynamics.forward_dynamics(system.robot, q, qd, tau - 0.5 * qd)
        >>> t = torch.arange(20, dtype=torch.float64)
        >>> data = forcegp.Dataset(t, q, qd, tau, qdd, system.robot.joint_names)
        >>> import tempfile
        >>> fit = forcegp.AnalyticalModel(system).fit(data)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     fit.save(f"{folder}/model")
        ...     load_model(f"{folder}/model").kind
        'analytical'

    Raises:
        ModelError: no model is there, it is damaged, or a constraint is to be given.
        UnknownNameError: the model is of a kind that this release does not know.
    """
    return _restored(*read_model(path), str(model_path(path)), system)


def model_of_bytes(data: bytes) -> FittedModel:
    """Read a model from the content of its file.

    Raises:
        ModelError, UnknownNameError: see `load_model`.
    """
    source = "a model of another process"
    return _restored(*parse_model(data, source), source)


def _restored(
    header: ModelHeader, tensors: Mapping[str, Tensor], source: str, system: ConstrainedSystem | None = None
) -> FittedModel:
    """The model of a header and tensors."""
    if header.kind not in LOADERS:
        raise UnknownNameError(f"kind of models in {source}", header.kind, LOADERS)
    model_system = unpack_system(header.system, tensors, source, system)
    return LOADERS[header.kind](header, model_tensors(tensors), model_system, source)


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
