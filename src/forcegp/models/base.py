"""Models of the forward dynamics: a specification, and the fitted model that predicts.

Fitted models of accelerations alone, which know neither contacts nor forces.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ModelError
from forcegp.files import Record
from forcegp.forces.quantities import FlatStates, ForceLinearization, flat_states, linearize_field
from forcegp.gp.optimise import Progress
from forcegp.models.fit_result import HasResult, fit_table, model_line
from forcegp.models.prediction import Prediction
from forcegp.rollout.forward import rollout_model
from forcegp.rollout.inputs import Torque
from forcegp.rollout.law import ForceField
from forcegp.rollout.trajectory import Rollout
from forcegp.storage.model_file import ModelHeader, write_model

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from forcegp.plots import Target


FitProgress = Callable[[int, int, float], None]
"""Called with the number of evaluations, their maximum, and the objective."""


def reported(progress: FitProgress | None, most: int, before: int = 0) -> Progress | None:
    """The progress of an optimisation of at most so many evaluations, after those `before`."""
    if progress is None:
        return None
    return lambda evaluations, value, _: progress(before + evaluations, most, value)


class Predictor(ABC):
    """A forward dynamics (q, q̇, τ) ↦ q̈ that predicts."""

    kind: str
    """Name of the class of models in saved files."""
    has_function_samples: bool = False
    """Whether `force_samples` draws functions from a posterior over forces."""

    system: ConstrainedSystem
    """Robot and contacts that predictions refer to."""

    @abstractmethod
    def predict(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str = "qdd",
        *,
        active: Tensor | None = None,
        covariance: bool = True,
        system: ConstrainedSystem | None = None,
    ) -> Prediction:
        """Predict a quantity at states `(*batch, nq)`.

        Args:
            q, qd, tau: `(*batch, nq)` states.
            quantity: what to predict.
            active: `(*batch, n_contacts)` bool, which contacts are closed; default all.
            covariance: whether to compute the covariance.
            system: another system to predict on, for models of forces.
        """

    def force_field(self) -> ForceField | None:
        """The mean impressed force Q̄ `(n, nq)` at states, or `None` for a model of accelerations alone."""
        return None

    @property
    def torque_disturbance(self) -> Tensor | None:
        """Root of the spectral density of torque noise `(nq,)` [N m √s], where one was learned with its
        correlation in time."""
        return None

    def force_samples(self, samples: int, generator: torch.Generator) -> ForceField:
        """Force functions drawn from the posterior, all evaluated at once.

        Args:
            samples: number S of functions.
            generator: source of the draws.

        Returns:
            A force field on `(S * k, nq)` states, of which the s-th run of k belongs to function s.

        Raises:
            ModelError: the model has no posterior over force functions.
        """
        raise ModelError(
            f"a {self.kind!r} model has no function samples", hint="use StructuredGP, or samples=0"
        )

    def linearize(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        *,
        active: Tensor | None = None,
        system: ConstrainedSystem | None = None,
    ) -> ForceLinearization:
        """Mean acceleration and multiplier with their Jacobians by q, q̇ and τ, for control and filters.

        Args:
            q, qd, tau: `(*batch, nq)` states.
            active: `(*batch, n_contacts)` bool, which contacts are closed; default all.
            system: another system to predict on.

        Raises:
            ModelError: the model knows no forces.
            ShapeError: an argument does not fit the system.
        """
        force = self.force_field()
        if force is None:
            raise ModelError(
                f"a {self.kind!r} model has no force field to linearize",
                hint="use StructuredGP or AnalyticalModel",
            )
        return linearize_field(force, system or self.system, q, qd, tau, active)

    def rollout(
        self,
        q0: Tensor,
        qd0: Tensor,
        tau: Torque,
        duration: float = 10.0,
        samples: int = 0,
        **settings: Any,
    ) -> Rollout:
        """Predict trajectories from initial states (section 4); see `forcegp.rollout.rollout_model`.

        Args:
            q0, qd0: `(*batch, nq)` initial states.
            tau: motor torque over time: a log, or an array `(samples, nq)` or `(*batch, samples, nq)` with
                its period in `options`; or a law of (t, q, q̇).
            duration: simulated time [s].
            samples: number of function samples to integrate besides the mean.
            **settings: `options`, `seed`, `active`, `system` and `progress` of `rollout_model`.
        """
        return rollout_model(self, q0, qd0, tau, duration, samples, **settings)

    def score(self, data: Dataset, quantity: str = "qdd") -> float:
        """Coefficient of determination R² of the predicted mean on a data set, as in scikit-learn.

        R² = 1 − Σ(measured − predicted)² / Σ(measured − mean)², averaged over the components: 1 is perfect, 0
        as good as the mean of the data, and negative worse. It says nothing about the uncertainty;
        `forcegp.evaluate` does.

        Args:
            data: logged states and measured values.
            quantity: what to predict; the data set must contain it.

        Raises:
            UnknownNameError, NotLoggedError: the quantity is unknown or not logged.
            DataError: the joints are not those of the robot, or the quantity does not vary.
        """
        from forcegp.models.measured import score

        return score(self, data, quantity)

    def plot(
        self,
        data: Dataset,
        quantity: str = "qdd",
        *,
        joints: Sequence[str] | None = None,
        ax: Target = None,
        **settings: Any,
    ) -> list[Axes]:
        """Draw a predicted quantity with ±2 standard deviations beside the measured one, if it is logged.

        Args:
            data: logged states; of a long log, every k-th row is predicted and drawn.
            quantity: what to predict.
            joints: which joints or contacts, of a quantity with several; default all.
            ax: matplotlib axes to draw on, one per panel; default a new figure.
            **settings: further arguments of `predict`, such as `noise=True` for the band of a measurement.

        Returns:
            The axes, one per panel.

        Raises:
            UnknownNameError: no such quantity or joint.
            ParameterError: the number of axes is not that of the panels.
        """
        from forcegp.models.measured import plot_model

        return plot_model(self, data, quantity, joints, ax, settings)

    @abstractmethod
    def save(self, path: str | Path) -> None:
        """Write the model to a file; `forcegp.load_model` reads it back exactly.

        Args:
            path: the file; `.safetensors` is added if it is left out.

        Raises:
            ModelError: a part of the model is Python code.
            OSError: the place cannot be written.
        """


class FittedModel(HasResult, Predictor):
    """A model with learned parameters; immutable."""

    def __repr__(self) -> str:
        """One line: robot, contacts, and how the fit went."""
        return model_line(type(self).__name__, self.system, self.result)

    def _repr_html_(self) -> str:
        """A table for notebooks."""
        return fit_table(repr(self), self.result, self.described())

    def described(self) -> list[tuple[str, object]]:
        """What was learned, by name, for tables."""
        return []

    @classmethod
    @abstractmethod
    def restored(
        cls, header: ModelHeader, tensors: Mapping[str, Tensor], system: ConstrainedSystem, source: str
    ) -> FittedModel:
        """The model that `save` wrote.

        Args:
            header: of the file, with the settings that `record` gave.
            tensors: as `record` gave them.
            system: robot and contacts.
            source: name of the file, for messages.

        Raises:
            ModelError: a tensor or setting is missing or not valid; names file and field.
        """

    @abstractmethod
    def record(self) -> tuple[Record, dict[str, Tensor]]:
        """Settings and tensors that the model can be restored from."""

    def save(self, path: str | Path) -> None:
        write_model(path, self.kind, self.system, *self.record())


F = TypeVar("F", bound=FittedModel)


class Model(ABC, Generic[F]):
    """A specification, which never changes: `fit` learns from data and returns a fitted model."""

    kind: str
    """Name of the class of models in saved files."""
    system: ConstrainedSystem
    """Robot and contacts."""

    _params: dict[str, Any]

    def _keep(self, arguments: Mapping[str, Any]) -> None:
        """Keep the arguments of the constructor: its `locals()`."""
        self._params = {name: x for name, x in arguments.items() if name not in ("self", "__class__")}

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> None:
            """Raise `AttributeError`, which says how to get the fit that has the attribute."""
            hint = "; call fit = model.fit(data), which has it" if hasattr(FittedModel, name) else ""
            raise AttributeError(f"a {type(self).__name__} has no attribute {name!r}{hint}")

    def __repr__(self) -> str:
        """One line: robot and contacts."""
        return model_line(type(self).__name__, self.system, None)

    def _repr_html_(self) -> str:
        """A table for notebooks."""
        return fit_table(repr(self), None, list(self.get_params().items()))

    def get_params(self) -> dict[str, Any]:
        """Arguments of the constructor as the caller passed them: `type(model)(**model.get_params())` is a
        copy."""
        return dict(self._params)

    @abstractmethod
    def fit(
        self,
        data: Dataset,
        *,
        progress: FitProgress | None = None,
        checkpoint: str | Path | None = None,
    ) -> F:
        """Learn from a data set.

        Args:
            data: states and measurements.
            progress: called now and then.
            checkpoint: file that records a long fit; a fit that finds it resumes there, to the same bits.
                Remove it once the fitted model is saved.

        Returns:
            The fitted model. Fitting twice gives the same bits.
        """


class AccelerationFit(FittedModel):
    """Predicts accelerations of the system that it was fitted on."""

    @torch.no_grad()
    def predict(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str = "qdd",
        *,
        active: Tensor | None = None,
        covariance: bool = True,
        system: ConstrainedSystem | None = None,
    ) -> Prediction:
        """Mean `(*batch, nq)` and covariance `(*batch, nq, nq)` of the accelerations, without noise.

        The arguments are those of `Predictor.predict`. The covariance, where the model has one, is diagonal.
        The only quantity is `qdd`, and `active` has no effect: the model knows neither forces nor contacts.

        Raises:
            ModelError: another quantity, or another system, is asked for.
            ShapeError: a state does not fit the robot.
        """
        if quantity != "qdd":
            raise ModelError(
                f"a {self.kind!r} model predicts accelerations only",
                expected="qdd",
                got=quantity,
                hint="use StructuredGP for forces and multipliers",
            )
        if system is not None and system is not self.system:
            raise ModelError(
                f"a {self.kind!r} model knows no forces, so it cannot predict on another system",
                hint="use StructuredGP, or leave out `system`",
            )
        at = flat_states(self.system, q, qd, tau, active)
        mean, variance = self.accelerations(at, covariance)
        mean = mean.reshape(*at.batch, mean.shape[-1])
        spread = None if variance is None else torch.diag_embed(variance.reshape(mean.shape))
        return Prediction(mean, spread, {"qdd": slice(0, mean.shape[-1])})

    @abstractmethod
    def accelerations(self, at: FlatStates, variance: bool) -> tuple[Tensor, Tensor | None]:
        """Mean `(n, nq)` at states and, on request and where the model has one, variance `(n, nq)`."""
