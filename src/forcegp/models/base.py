"""Models of forward dynamics: specifications, and fitted models for prediction.

`AccelerationFit` is the base class of models that predict only accelerations, without contacts or forces.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ModelError
from forcegp.files import Record
from forcegp.forces.quantities import FlatStates
from forcegp.gp.optimise import FitProgress
from forcegp.models.fit_result import FitResult, fit_table, model_line
from forcegp.models.prediction import Answer, Predictor, Query
from forcegp.storage.model_file import ModelHeader, write_model


class FittedModel(Predictor):
    """An immutable model with learned parameters."""

    result: FitResult
    """Result of the fit."""

    def __repr__(self) -> str:
        """Return a one-line summary of the robot, its contacts and the fit."""
        return model_line(type(self).__name__, self.system, self.result)

    def _repr_html_(self) -> str:
        """Return a table for notebooks."""
        return fit_table(repr(self), self.result, self.described())

    def described(self) -> list[tuple[str, object]]:
        """Return the names and values of the learned parameters for display in tables."""
        return []

    @classmethod
    @abstractmethod
    def restored(
        cls, header: ModelHeader, tensors: Mapping[str, Tensor], system: ConstrainedSystem, source: str
    ) -> FittedModel:
        """Restore a saved model.

        Args:
            header: header of the file, which contains the settings from `record`.
            tensors: the tensors from `record`.
            system: the robot and its contacts.
            source: name of the file, used in messages.

        Raises:
            ModelError: a tensor or setting is missing or invalid. The message names the file and the field.
        """

    @abstractmethod
    def record(self) -> tuple[Record, dict[str, Tensor]]:
        """Return the settings and tensors from which the model can be restored."""

    def save(self, path: str | Path) -> None:
        write_model(path, self.kind, self.system, *self.record())


F = TypeVar("F", bound=FittedModel)


class Model(ABC, Generic[F]):
    """An immutable specification of a model. `fit` learns from data and returns a fitted model."""

    kind: str
    """Name of the model class in saved files."""
    system: ConstrainedSystem
    """Robot and contacts."""

    _params: dict[str, Any]

    def _keep(self, arguments: Mapping[str, Any]) -> None:
        """Store the arguments of the constructor, which are passed as its `locals()`."""
        self._params = {name: x for name, x in arguments.items() if name not in ("self", "__class__")}

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> None:
            """Raise `AttributeError`, with a hint if the fitted model has the attribute."""
            hint = "; call fit = model.fit(data), which has it" if hasattr(FittedModel, name) else ""
            raise AttributeError(f"a {type(self).__name__} has no attribute {name!r}{hint}")

    def __repr__(self) -> str:
        """Return a one-line summary of the robot and its contacts."""
        return model_line(type(self).__name__, self.system, None)

    def _repr_html_(self) -> str:
        """Return a table for notebooks."""
        return fit_table(repr(self), None, list(self.get_params().items()))

    def get_params(self) -> dict[str, Any]:
        """Return the arguments of the constructor. `type(model)(**model.get_params())` is a copy."""
        return dict(self._params)

    @abstractmethod
    def fit(self, data: Dataset, *, progress: FitProgress | None = None) -> F:
        """Learn from a data set.

        Args:
            data: states and measurements.
            progress: a function called during the fit.

        Returns:
            The fitted model. Repeated fits give bit-identical results.
        """


class AccelerationFit(FittedModel):
    """A model that predicts only the accelerations of one system, without forces or contacts."""

    def at(self, flat: FlatStates, query: Query) -> Answer:
        if query.quantity != "qdd":
            raise ModelError(
                f"a {self.kind!r} model predicts only accelerations",
                expected="qdd",
                got=query.quantity,
                hint="use StructuredGP for forces and multipliers",
            )
        if query.system not in (None, self.system):
            raise ModelError(
                f"a {self.kind!r} model has no forces, so it cannot predict on another system",
                hint="use StructuredGP, or omit `system`",
            )
        mean, variance = self.accelerations(flat, query.covariance)
        spread = None if variance is None else torch.diag_embed(variance)
        return (mean, spread, None, None), {"qdd": slice(0, mean.shape[-1])}, ()

    @abstractmethod
    def accelerations(self, at: FlatStates, variance: bool) -> tuple[Tensor, Tensor | None]:
        """Return the mean at n states and, if requested and available, the variance, both `(n, nq)`."""
