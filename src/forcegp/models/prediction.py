"""Predictors, and predicted quantities with their uncertainty, scores and plots."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import InitVar, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.data import Dataset
from forcegp.data.fields import AXES
from forcegp.errors import DataError, ForceGPError, ModelError, NumericalError, ShapeError, check_name
from forcegp.forces.measurements import COLUMNS
from forcegp.forces.posterior import warnings_beyond
from forcegp.forces.quantities import FlatStates, ForceLinearization, flat_states, linearize_field
from forcegp.rollout.forward import rollout_model
from forcegp.rollout.inputs import ForwardModel, Torque
from forcegp.rollout.trajectory import Rollout

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from forcegp.plots import Panel, Target

CHUNK = 2000
"""Number of states predicted at a time, to bound memory."""
CHECKED = 1 << 16
"""Number of covariances checked at a time."""
MOST_SAMPLES = 2000
"""Maximum number of samples in a plot; more would be indistinguishable."""
NEGATIVE = 0.01
"""Magnitude, relative to the variances, below which a negative eigenvalue counts as a rounding error."""
ROUNDING = 1e-12
"""Smallest variance used for scaling, relative to the largest variance of a sample."""


@dataclass(frozen=True, repr=False)
class Prediction:
    """A predicted quantity at a batch of states.

    Attributes:
        mean: mean `(*batch, d)`.
        covariance: covariance `(*batch, d, d)` of the noise-free quantity, or of the noisy quantity if noise
            was requested. It is `None` if it was not requested, or if the model does not provide it.
        parts: the slice of each requested quantity.
        beyond: distance `(*batch, nq)` by which the speed and torque of each joint exceed the training data,
            in standard deviations of these data, or `None` if the model does not provide it.
        joint_names: names of the joints in the order of `beyond`.
        determined: mask `(*batch, d)` of the components that the data and the motion determine, or `None` if
            all are determined. The other components are NaN.
        doubts: descriptions of the undetermined components.
        checked: whether the mean and covariance have already been checked, as the C code does.
    """

    mean: Tensor
    covariance: Tensor | None = None
    parts: dict[str, slice] = field(default_factory=dict)
    beyond: Tensor | None = None
    joint_names: tuple[str, ...] = ()
    determined: Tensor | None = field(default=None, kw_only=True)
    doubts: tuple[str, ...] = field(default=(), kw_only=True)
    checked: InitVar[bool] = field(default=False, kw_only=True)

    def __post_init__(self, checked: bool) -> None:
        """Reject non-finite numbers and invalid covariances.

        Raises:
            NumericalError: a determined value is not finite, or an eigenvalue is clearly negative.
        """
        if checked:
            return
        mean, covariance = self.mean, self.covariance
        if self.determined is not None:
            mean = mean.where(self.determined, 0.0)
            if covariance is not None:
                both = self.determined[..., None] & self.determined[..., None, :]
                covariance = covariance.where(both, 0.0)
        for name, value in (("mean", mean), ("covariance", covariance)):
            # A sum is finite only if all its terms are.
            if value is None or math.isfinite(float(value.sum())):
                continue
            wrong = sum(int((~torch.isfinite(piece)).sum()) for piece in value.reshape(-1).split(1 << 20))
            if wrong:
                raise NumericalError(
                    f"the {name} of a prediction is not finite",
                    got=f"{wrong} of {value.numel()} numbers",
                    hint="implausible states cause overflow; check q, qd and tau",
                )
        if covariance is not None:
            d = covariance.shape[-1]
            for piece in covariance.reshape(-1, d, d).split(CHECKED) if d else ():
                require_semidefinite(piece)

    @property
    def variance(self) -> Tensor | None:
        """Variances `(*batch, d)`, the diagonal of the covariance."""
        return None if self.covariance is None else self.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0)

    @property
    def std(self) -> Tensor | None:
        """Standard deviations `(*batch, d)`."""
        variance = self.variance
        return None if variance is None else variance.sqrt()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about undetermined components, and about states far beyond the training data."""
        beyond = () if self.beyond is None else warnings_beyond(self.beyond, self.joint_names)
        return (*self.doubts, *beyond)

    def __repr__(self) -> str:
        """Return a one-line summary of the shapes, without numbers."""
        what = ", ".join(self.parts) or "values"
        bars = "no uncertainty" if self.covariance is None else "with covariance"
        return f"<Prediction of {what}: mean {tuple(self.mean.shape)}, {bars}>"

    def plot(
        self,
        t: Tensor | None = None,
        *,
        measured: Tensor | None = None,
        names: Sequence[str] | None = None,
        ax: Target = None,
    ) -> list[Axes]:
        """Plot the mean with a band of ±2 standard deviations, one panel per component.

        `model.plot(data)` takes the names, times and measurements from a data set.

        Args:
            t: time of each sample `(n,)` [s]. By default, the samples are numbered.
            measured: measured values for comparison, `(n, d)`.
            names: names of the components.
            ax: matplotlib axes to draw on, one per panel. By default, a new figure is created.

        Returns:
            The axes, one per panel.

        Raises:
            ShapeError: the mean does not have shape `(n, d)`, or an argument does not match it.
            ParameterError: the number of axes differs from the number of components.
        """
        from forcegp.plots import Timeline, axis_label, draw_panels

        if self.mean.ndim != 2:
            raise ShapeError(
                "only predictions for a single list of states can be plotted",
                expected="a mean of shape (n, d)",
                got=tuple(self.mean.shape),
            )
        n, d = self.mean.shape
        names = [f"component {i + 1}" for i in range(d)] if names is None else list(names)
        for what, value, expected in (
            ("t", None if t is None else tuple(t.shape), (n,)),
            ("measured", None if measured is None else tuple(measured.shape), (n, d)),
            ("names", (len(names),), (d,)),
        ):
            if value is not None and value != expected:
                raise ShapeError(f"{what} does not match the prediction", expected=expected, got=value)
        label = axis_label(next(iter(self.parts)) if len(self.parts) == 1 else "")
        panels = [self.panel(i, names[i], label, measured) for i in range(d)]
        axes = draw_panels(panels, Timeline.of(torch.arange(n) if t is None else t), (), ax)
        if t is None:
            axes[-1].set_xlabel("sample")
        return axes

    def panel(self, i: int, name: str, label: str, true: Tensor | None) -> Panel:
        """Return a panel for component i, with the measured values if there are any."""
        from forcegp.plots import MEASURED, PREDICTED, Curve, Panel

        curves = [] if true is None else [Curve(true[:, i], "measured", MEASURED, width=0.7)]
        band = None if self.std is None else self.std[:, i]
        return Panel(name, label, [*curves, Curve(self.mean[:, i], "predicted", PREDICTED, band)])


class Query(NamedTuple):
    """Arguments of `Predictor.predict`. By default, the system is that of the fit."""

    quantity: str | Sequence[str]
    system: ConstrainedSystem | None
    covariance: bool
    noise: bool


Answer = tuple[tuple[Tensor | None, ...], dict[str, slice], tuple[str, ...]]
"""Mean `(n, d)`, covariance `(n, d, d)`, distance beyond the trained region `(n, nq)`, mask of determined
    components `(n, d)`; slice of each quantity; and descriptions of undetermined components."""


def in_pieces(
    at: FlatStates, read: Callable[[FlatStates], tuple[Tensor | None, ...]]
) -> tuple[Tensor | None, ...]:
    """Evaluate `read` on `CHUNK` states at a time to keep only the result and one piece in memory."""
    whole, n = list[Tensor | None](), len(at.q)
    for first in range(0, max(n, 1), CHUNK):
        piece = read(at.rows(slice(first, first + CHUNK)))
        whole = whole or [x if x is None or n <= CHUNK else x.new_empty(n, *x.shape[1:]) for x in piece]
        for target, x in zip(whole, piece, strict=True):
            if target is not None and x is not None and target is not x:
                target[first : first + CHUNK] = x
    return tuple(x if x is None else x.reshape(*at.batch, *x.shape[1:]) for x in whole)


def measured(system: ConstrainedSystem, data: Dataset, quantity: str) -> Tensor:
    """Return the logged values `(n, d)` of a quantity.

    Raises:
        UnknownNameError: the quantity cannot be measured, or a contact of the system is not logged.
        NotLoggedError: the quantity is not logged.
    """
    check_name("measured quantity", quantity, COLUMNS)
    return COLUMNS[quantity](data, system)


def component_names(system: ConstrainedSystem, quantity: str) -> list[str]:
    """Return the names of a quantity's components: joints, constraint rows, or axes of contact forces."""
    if quantity == "contact_force":
        contacts = [c.name for c in system.contacts if isinstance(c, SurfaceContact)]
        return [f"{name} {axis}" for name in contacts for axis in AXES]
    return system.row_names if quantity == "multiplier" else list(system.robot.joint_names)


class Predictor(ForwardModel):
    """A model that predicts the forward dynamics (q, q̇, τ) ↦ q̈."""

    has_noise: bool = False
    """Whether predictions can include the noise of measurements."""

    @torch.no_grad()
    def predict(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str | Sequence[str] = "qdd",
        *,
        active: Tensor | None = None,
        covariance: bool = True,
        system: ConstrainedSystem | None = None,
        noise: bool = False,
    ) -> Prediction:
        """Predict the mean and covariance of a quantity. `StructuredGP` uses the posterior (eq. 22).

        Args:
            q, qd, tau: states, `(*batch, nq)`.
            quantity: a name in `PREDICTED`. If the model has forces, several names give their joint
                distribution. `"joint_friction"` is the friction of the joints [N m, N], which includes the
                friction in the robot file.
            active: mask `(*batch, n_contacts)` of closed contacts. By default, all contacts are closed.
            covariance: whether to compute the covariance, which is more expensive than the mean.
            system: a different system, such as one with a different surface, if the model predicts forces. On
                the system of the fit, forces of contacts that are never closed in training are undetermined.
            noise: whether to include the noise of torques and sensors in the covariance.

        Returns:
            The mean `(*batch, d)` and, if the model provides it, the covariance `(*batch, d, d)`.

        Raises:
            UnknownNameError: the quantity does not exist.
            ShapeError: a state or `active` does not match the system.
            ModelError: all requested forces belong to contacts that are never closed in the training data, or
                a model that predicts only accelerations does not support the quantity, system or noise.
        """
        if noise and not self.has_noise:
            raise ModelError(f"a {self.kind!r} model has no noise of measurements", hint="use StructuredGP")
        flat = flat_states(system or self.system, q, qd, tau, active)
        return self._answered(flat, Query(quantity, system, covariance, noise))

    def _answered(self, flat: FlatStates, query: Query) -> Prediction:
        parts, doubts = dict[str, slice](), dict[str, None]()

        def read(flat: FlatStates) -> tuple[Tensor | None, ...]:
            values, slices, descriptions = self.at(flat, query)
            parts.update(slices)
            doubts.update(dict.fromkeys(descriptions))
            return values

        mean, spread, beyond, determined = in_pieces(flat, read)
        assert mean is not None
        joints, known = (query.system or self.system).robot.joint_names, determined if doubts else None
        return Prediction(mean, spread, parts, beyond, joints, determined=known, doubts=tuple(doubts))

    def at(self, flat: FlatStates, query: Query) -> Answer:
        """Evaluate a query at n states."""
        raise NotImplementedError

    @property
    def specified(self) -> ConstrainedSystem:
        """System before the fit, with the robot from the file if the fit retains it."""
        return self.system

    def linearize(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        *,
        active: Tensor | None = None,
        system: ConstrainedSystem | None = None,
    ) -> ForceLinearization:
        """Return the mean acceleration and multiplier, and their Jacobians with respect to q, q̇ and τ.

        Args:
            q, qd, tau: states, `(*batch, nq)`.
            active: mask `(*batch, n_contacts)` of closed contacts. By default, all contacts are closed.
            system: a different system for which to predict the motion.

        Raises:
            ModelError: the model does not predict forces.
            ShapeError: an argument does not match the system.
        """
        force = self.force_field()
        if force is None:
            raise ModelError(
                f"a {self.kind!r} model has no force field to linearize",
                hint="use StructuredGP or AnalyticalModel",
            )
        return linearize_field(force, system or self.system, q, qd, tau, active)

    def rollout(
        self, q0: Tensor, qd0: Tensor, tau: Torque, duration: float = 10.0, samples: int = 0, **settings: Any
    ) -> Rollout:
        """Predict trajectories from initial states (section 4), as in `forcegp.rollout.rollout_model`.

        Args:
            q0, qd0: initial states, `(*batch, nq)`.
            tau: motor torque over time. It is a log, a function of (t, q, q̇), or an array `(samples, nq)` or
                `(*batch, samples, nq)`. The sampling period of an array is set in `options`.
            duration: simulated time [s].
            samples: number of function samples to integrate in addition to the mean.
            **settings: the arguments `options`, `seed`, `active`, `system` and `progress` of `rollout_model`.
        """
        return rollout_model(self, q0, qd0, tau, duration, samples, **settings)

    def score(self, data: Dataset, quantity: str = "qdd") -> float:
        """Return the coefficient of determination R² of the predicted mean on a data set, as in scikit-learn.

        R² = 1 − Σ(measured − predicted)² / Σ(measured − mean)², averaged over the components. A perfect
        prediction scores 1. Predicting the mean of the data scores 0, and negative scores are worse. Unlike
        `forcegp.evaluate`, the score ignores the uncertainty.

        Args:
            data: logged states and measured values.
            quantity: the quantity to predict. The data set must contain it.

        Raises:
            UnknownNameError, NotLoggedError: the quantity is unknown or was not logged.
            DataError: the joints differ from those of the robot, or the quantity is constant.
        """
        data.check_robot(self.specified.robot)
        if len(data) < 2:
            raise DataError("a score requires at least two samples", got=len(data))
        true = measured(self.system, data, quantity)
        mean = self._at_logged(data, quantity, covariance=False).mean
        unexplained = (true - mean).square().sum(0)
        spread = (true - true.mean(0)).square().sum(0)
        if not bool((spread > 0.0).any()):
            raise DataError(f"{quantity} is constant in the data, so a score is not defined")
        return float((1.0 - unexplained / spread)[spread > 0.0].mean())

    def plot(
        self,
        data: Dataset,
        quantity: str = "qdd",
        *,
        joints: Sequence[str] | None = None,
        ax: Target = None,
        **settings: Any,
    ) -> list[Axes]:
        """Plot a predicted quantity with ±2 standard deviations, and with the measured values if logged.

        Args:
            data: logged states. For a long log, only every k-th row is predicted and plotted.
            quantity: the quantity to predict.
            joints: names of the joints or contacts to plot. By default, all are plotted.
            ax: matplotlib axes to draw on, one per panel. By default, a new figure is created.
            **settings: other arguments of `predict`. With `noise=True`, the band includes noise.

        Returns:
            The axes, one per panel.

        Raises:
            UnknownNameError: the quantity or joint does not exist.
            ParameterError: the number of axes differs from the number of panels.
        """
        from forcegp.plots import Timeline, axis_label, chosen, draw_panels

        system = settings.get("system") or self.system
        data.check_robot((settings.get("system") or self.specified).robot)
        data = data[:: max(1, -(-len(data) // MOST_SAMPLES))]
        prediction = self._at_logged(data, quantity, **settings)
        try:
            true = measured(system, data, quantity)
        except ForceGPError:
            true = None
        names, kinds = component_names(system, quantity), system.robot.joint_types
        of_joints = names == list(system.robot.joint_names)
        panels = [
            prediction.panel(i, names[i], axis_label(quantity, kinds[i : i + 1] if of_joints else ()), true)
            for i in chosen(joints, names, f"component of {quantity}")
        ]
        time = Timeline.of(data.t, data.segment, data.header.ordered)
        return draw_panels(panels, time, [data.contact[c] for c in system.contact_names], ax)

    def _at_logged(self, data: Dataset, quantity: str | Sequence[str], **settings: Any) -> Prediction:
        """Predict a quantity at the logged states and contacts."""
        active = data.active((settings.get("system") or self.system).contact_names)
        return self.predict(data.q, data.qd, data.tau, quantity, active=active, **settings)

    @abstractmethod
    def save(self, path: str | Path) -> None:
        """Save the model to a file from which `forcegp.load_model` restores it exactly.

        Args:
            path: the file. The suffix `.safetensors` is added if it is missing.

        Raises:
            ModelError: a part of the model is defined in Python.
            OSError: the path cannot be written.
        """


def require_semidefinite(covariance: Tensor) -> None:
    """Reject covariances with a clearly negative eigenvalue after scaling to unit variances.

    Args:
        covariance: covariances, `(*batch, d, d)`.

    Raises:
        NumericalError: a scaled variance or eigenvalue is below −`NEGATIVE`.
    """
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    if not variance.numel():
        return
    largest = variance.amax(-1, keepdim=True)
    scale = variance.clamp(min=ROUNDING * largest.clamp(min=0.0)).sqrt()
    scale = torch.where(scale > 0.0, scale, 1.0)
    shifted = covariance / scale[..., :, None] / scale[..., None, :]
    shifted.diagonal(dim1=-2, dim2=-1).add_(NEGATIVE)
    negative = torch.linalg.cholesky_ex(shifted).info != 0
    if bool(negative.any()):
        worst = float(torch.linalg.eigvalsh(covariance[negative]).min())
        raise NumericalError(
            f"{int(negative.sum())} of {negative.numel()} covariances of a prediction are not positive "
            "semidefinite",
            got=f"an eigenvalue of {worst:.2g}",
            hint="the posterior is dominated by rounding: specify a larger noise, or remove outliers",
        )
