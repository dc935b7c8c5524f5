"""Loading of saved models of any kind. Pickling and copying use the same format."""

from __future__ import annotations

import copyreg
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ForceGPError, ModelError, check_name
from forcegp.gp.exact import ExactPosterior
from forcegp.models.analytical import AnalyticalFit
from forcegp.models.base import FittedModel
from forcegp.models.independent_gp import IndependentFit
from forcegp.models.neural import NetworkFit
from forcegp.models.structured_fit import StructuredFit
from forcegp.storage.model_file import ModelHeader, model_bytes, model_path, parse_model, read_model
from forcegp.storage.system import PREFIX, unpack_system

KINDS: dict[str, type[FittedModel]] = {
    kind.kind: kind for kind in (AnalyticalFit, NetworkFit, IndependentFit, StructuredFit)
}
"""Fitted models, keyed by their name in files."""


def load_model(path: str | Path, *, system: ConstrainedSystem | None = None) -> FittedModel:
    """Load a saved model. Its predictions are bit-identical to those before saving.

    Args:
        path: the file. The suffix `.safetensors` is added if it is missing.
        system: a system with the constraints that were defined in Python, such as an `ImplicitSurface`. The
            robot and all other constraints are read from the file.

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
        ModelError: the file is missing or damaged, or a constraint must be passed in `system`.
        UnknownNameError: this release does not support this kind of model.
    """
    return _restored(*read_model(path), str(model_path(path)), system)


def model_of_bytes(data: bytes) -> FittedModel:
    """Load a model from the content of a model file.

    Raises:
        ModelError, UnknownNameError: see `load_model`.
    """
    source = "a model of another process"
    return _restored(*parse_model(data, source), source)


def _restored(
    header: ModelHeader, tensors: Mapping[str, Tensor], source: str, system: ConstrainedSystem | None = None
) -> FittedModel:
    """Restore a model from its header and tensors."""
    check_name(f"kind of models in {source}", header.kind, KINDS)
    model_tensors = {name: value for name, value in tensors.items() if not name.startswith(PREFIX)}
    try:
        model_system = unpack_system(header.system, tensors, source, system)
        model = KINDS[header.kind].restored(header, model_tensors, model_system, source)
        _check(model)
        return model
    except ForceGPError:
        raise
    except Exception as cause:
        got = f"{type(cause).__name__}: {cause}"[:300]
        raise ModelError(f"{source}: the parts of the model contradict each other", got=got) from cause


@torch.no_grad()
def _check(model: FittedModel) -> None:
    """Predict at some states, which raises an error if the shapes or types of the tensors do not match.

    Their number differs from all other dimensions. An exact posterior is not factorised at this point.
    """
    robot = model.system.robot
    n = 1 + max(robot.nq, len(model.system.contacts), model.system.m)
    state = torch.zeros(n, robot.nq, dtype=robot.dtype, device=robot.device)
    closed = torch.arange(n, device=robot.device)[:, None].expand(n, len(model.system.contacts)) % 2 == 0
    exact = isinstance(model, StructuredFit) and isinstance(model.posterior.latent, ExactPosterior)
    noise = isinstance(model, StructuredFit) and not exact
    options: dict[str, Any] = {"covariance": not exact, "noise": noise}
    for quantity in ("qdd", "multiplier"):
        with suppress(ForceGPError):  # a valid model may not determine a force in this position
            model.predict(state, state, state, quantity, active=closed, **options)


def register() -> None:
    """Register the file format for copying and pickling models."""
    for kind in KINDS.values():
        copyreg.pickle(kind, _sent)  # pyright: ignore[reportArgumentType]


def _sent(model: FittedModel) -> tuple[Any, ...]:
    """Return a function and its arguments, which restore a model from the content of its file."""
    return model_of_bytes, (model_bytes(model.kind, model.system, *model.record()),)
