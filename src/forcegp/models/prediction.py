"""Predictors, and predicted quantities with their uncertainty; scores, and plots with measured values."""

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
"""States that are predicted at once, to bound the memory."""
CHECKED = 1 << 16
"""Covariances that are checked at once."""
MOST_SAMPLES = 2000
"""Samples that are predicted and drawn: more are indistinguishable."""


NEGATIVE = 0.01
"""An eigenvalue below minus this fraction of the variances is no rounding of zero."""
ROUNDING = 1e-12
"""Variances below this fraction of the largest of a sample are compared with this fraction of it."""


@dataclass(frozen=True, repr=False)
class Prediction:
    """A predicted quantity at a batch of states.

    Attributes:
        mean: `(*batch, d)`.
        covariance: `(*batch, d, d)`, of the noise-free quantity unless noise was requested; `None` if the
            model has none or it was not requested.
        parts: the slice of each quantity, if several were requested.
        beyond: `(*batch, nq)` distance of the speed and torque of each joint beyond the training data, in
            training standard deviations; `None` for models without it.
        joint_names: the joints, in the order of `beyond`.
        determined: `(*batch, d)` bool, components determined by data and motion; the others are NaN. `None`
            for all.
        doubts: descriptions of undetermined components.
        checked: whether the maker has checked mean and covariance, as C code does.
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
        """Refuse numbers that are not finite, and covariances that are none.

        Raises:
            NumericalError: the mean or the covariance is not finite where it is determined, or an eigenvalue
                is clearly negative.
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
            # A sum is finite only if all numbers are.
            if value is None or math.isfinite(float(value.sum())):
                continue
            wrong = sum(int((~torch.isfinite(piece)).sum()) for piece in value.reshape(-1).split(1 << 20))
            if wrong:
                raise NumericalError(
                    f"the {name} of a prediction is not finite",
                    got=f"{wrong} of {value.numel()} numbers",
                    hint="states beyond what a robot can do overflow; check q, qd and tau",
                )
        if covariance is not None:
            d = covariance.shape[-1]
            for piece in covariance.reshape(-1, d, d).split(CHECKED) if d else ():
                require_semidefinite(piece)

    @property
    def variance(self) -> Tensor | None:
        """`(*batch, d)`, the diagonal of the covariance."""
        return None if self.covariance is None else self.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0)

    @property
    def std(self) -> Tensor | None:
        """`(*batch, d)` standard deviation."""
        variance = self.variance
        return None if variance is None else variance.sqrt()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts about the prediction: undetermined components, states far beyond the training data."""
        beyond = () if self.beyond is None else warnings_beyond(self.beyond, self.joint_names)
        return (*self.doubts, *beyond)

    def __repr__(self) -> str:
        """One line with shapes, without the numbers."""
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
        """Draw the mean with its band of ±2 standard deviations, one panel per component.

        `model.plot(data)` does the same with the names, the time and the measurements of a data set.

        Args:
            t: `(n,)` time of each sample [s]; by default samples are numbered.
            measured: `(n, d)` values to compare with.
            names: one per component.
            ax: matplotlib axes to draw on, one per panel; default a new figure.

        Returns:
            The axes, one per panel.

        Raises:
            ShapeError: the mean is not of shape `(n, d)`, or an argument does not fit it.
            ParameterError: the number of axes differs from that of the components.
        """
        from forcegp.plots import Timeline, axis_label, draw_panels

        if self.mean.ndim != 2:
            raise ShapeError(
                "only predictions over one list of states can be drawn",
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
                raise ShapeError(f"{what} does not fit the prediction", expected=expected, got=value)
        label = axis_label(next(iter(self.parts)) if len(self.parts) == 1 else "")
        panels = [self.panel(i, names[i], label, measured) for i in range(d)]
        axes = draw_panels(panels, Timeline.of(torch.arange(n) if t is None else t), (), ax)
        if t is None:
            axes[-1].set_xlabel("sample")
        return axes

    def panel(self, i: int, name: str, label: str, true: Tensor | None) -> Panel:
        """Component i with its measured values, if any."""
        from forcegp.plots import MEASURED, PREDICTED, Curve, Panel

        curves = [] if true is None else [Curve(true[:, i], "measured", MEASURED, width=0.7)]
        band = None if self.std is None else self.std[:, i]
        return Panel(name, label, [*curves, Curve(self.mean[:, i], "predicted", PREDICTED, band)])


class Query(NamedTuple):
    """Arguments of `Predictor.predict`; without a system, that of the fit is used."""

    quantity: str | Sequence[str]
    system: ConstrainedSystem | None
    covariance: bool
    noise: bool


Answer = tuple[tuple[Tensor | None, ...], dict[str, slice], tuple[str, ...]]
"""Mean `(n, d)`, covariance `(n, d, d)`, distance beyond the trained region `(n, nq)` and components that are
determined `(n, d)`; the slice of each quantity; what is not determined, in words."""


def in_pieces(
    at: FlatStates, read: Callable[[FlatStates], tuple[Tensor | None, ...]]
) -> tuple[Tensor | None, ...]:
    """Evaluate `read` on `CHUNK` states at a time; memory holds the result and one piece."""
    whole, n = list[Tensor | None](), len(at.q)
    for first in range(0, max(n, 1), CHUNK):
        piece = read(at.rows(slice(first, first + CHUNK)))
        whole = whole or [x if x is None or n <= CHUNK else x.new_empty(n, *x.shape[1:]) for x in piece]
        for target, x in zip(whole, piece, strict=True):
            if target is not None and x is not None and target is not x:
                target[first : first + CHUNK] = x
    return tuple(x if x is None else x.reshape(*at.batch, *x.shape[1:]) for x in whole)


def measured(system: ConstrainedSystem, data: Dataset, quantity: str) -> Tensor:
    """Logged values `(n, d)` of a quantity.

    Raises:
        UnknownNameError: the quantity cannot be measured, or a contact of the system is not logged.
        NotLoggedError: it is not logged.
    """
    check_name("measured quantity", quantity, COLUMNS)
    return COLUMNS[quantity](data, system)


def component_names(system: ConstrainedSystem, quantity: str) -> list[str]:
    """Owners of the components of a quantity: joints, contacts, or axes of a contact's force."""
    if quantity == "contact_force":
        contacts = [c.name for c in system.contacts if isinstance(c, SurfaceContact)]
        return [f"{name} {axis}" for name in contacts for axis in AXES]
    return system.row_names if quantity == "multiplier" else list(system.robot.joint_names)


class Predictor(ForwardModel):
    """A predictor of the forward dynamics (q, q̇, τ) ↦ q̈."""

    has_noise: bool = False
    """Whether it can predict measurements, their noise included."""

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
        """Mean and covariance of a quantity; for a `StructuredGP`, of its posterior (eqs. 22 to 25).

        Args:
            q, qd, tau: `(*batch, nq)` states.
            quantity: a name of `QUANTITIES`, or, for models with forces, several for their joint
                distribution.
            active: `(*batch, n_contacts)` bool, which contacts are closed; default all.
            covariance: whether to compute the covariance, which costs more than the mean.
            system: another system to predict on, such as another surface or none, for models with forces; on
                that of the fit, contacts that are never closed in the training data have undetermined forces.
            noise: whether the covariance is that of a measurement, including noise of torque and sensor.

        Returns:
            Mean `(*batch, d)` and, if the model has one, covariance `(*batch, d, d)`, without measurement
            noise by default.

        Raises:
            UnknownNameError: no such quantity.
            ShapeError: a state or `active` does not fit the system.
            ModelError: only forces of contacts that are never closed in the training data; or another
                quantity, another system or noise for a model of accelerations alone.
        """
        if noise and not self.has_noise:
            raise ModelError(f"a {self.kind!r} model has no noise of measurements", hint="use StructuredGP")
        query, parts = Query(quantity, system, covariance, noise), dict[str, slice]()
        doubts = dict[str, None]()

        def read(flat: FlatStates) -> tuple[Tensor | None, ...]:
            values, slices, own = self.at(flat, query)
            parts.update(slices)
            doubts.update(dict.fromkeys(own))
            return values

        own = system or self.system
        mean, spread, beyond, determined = in_pieces(flat_states(own, q, qd, tau, active), read)
        assert mean is not None
        joints, known = own.robot.joint_names, determined if doubts else None
        return Prediction(mean, spread, parts, beyond, joints, determined=known, doubts=tuple(doubts))

    def at(self, flat: FlatStates, query: Query) -> Answer:
        """The result of a query at n states."""
        raise NotImplementedError

    @property
    def specified(self) -> ConstrainedSystem:
        """The system before the fit, with the robot of the file if the fit keeps it."""
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
        """Mean acceleration and multiplier with their Jacobians with respect to q, q̇ and τ.

        Args:
            q, qd, tau: `(*batch, nq)` states.
            active: `(*batch, n_contacts)` bool, which contacts are closed; default all.
            system: another system to predict on.

        Raises:
            ModelError: the model has no forces.
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
                its period in `options`; or a feedback law of (t, q, q̇).
            duration: simulated time [s].
            samples: number of function samples to integrate besides the mean.
            **settings: `options`, `seed`, `active`, `system` and `progress` of `rollout_model`.
        """
        return rollout_model(self, q0, qd0, tau, duration, samples, **settings)

    def score(self, data: Dataset, quantity: str = "qdd") -> float:
        """Coefficient of determination R² of the predicted mean on a data set, as in scikit-learn.

        R² = 1 − Σ(measured − predicted)² / Σ(measured − mean)², averaged over the components: 1 is perfect, 0
        as good as the mean of the data, and negative worse. It ignores the uncertainty, unlike
        `forcegp.evaluate`.

        Args:
            data: logged states and measured values.
            quantity: what to predict; the data set must contain it.

        Raises:
            UnknownNameError, NotLoggedError: the quantity is unknown or not logged.
            DataError: the joints are not those of the robot, or the quantity does not vary.
        """
        data.check_robot(self.specified.robot)
        if len(data) < 2:
            raise DataError("a score needs two samples or more", got=len(data))
        true = measured(self.system, data, quantity)
        mean = self._at_logged(data, quantity, covariance=False).mean
        unexplained = (true - mean).square().sum(0)
        spread = (true - true.mean(0)).square().sum(0)
        if not bool((spread > 0.0).any()):
            raise DataError(f"{quantity} is constant in the data, so that a score is not defined")
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

    def _at_logged(self, data: Dataset, quantity: str, **settings: Any) -> Prediction:
        """The prediction at logged states; contacts are closed as logged."""
        active = data.active((settings.get("system") or self.system).contact_names)
        return self.predict(data.q, data.qd, data.tau, quantity, active=active, **settings)

    @abstractmethod
    def save(self, path: str | Path) -> None:
        """Write the model to a file; `forcegp.load_model` reads it back exactly.

        Args:
            path: the file; `.safetensors` is added if missing.

        Raises:
            ModelError: a part of the model is Python code.
            OSError: the path cannot be written.
        """


def require_semidefinite(covariance: Tensor) -> None:
    """Refuse covariances with a clearly negative eigenvalue, of variables in units of their standard
    deviation.

    Args:
        covariance: `(*batch, d, d)`.

    Raises:
        NumericalError: a variance or an eigenvalue is below −`NEGATIVE`.
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
            hint="the posterior is rounding: state a larger noise, or leave out outliers",
        )
