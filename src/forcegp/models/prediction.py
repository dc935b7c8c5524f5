"""A predicted quantity with its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from forcegp.errors import NumericalError
from forcegp.forces.noise import warnings_beyond
from forcegp.gp.factor import require_semidefinite

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from forcegp.plots import Target


@dataclass(frozen=True, repr=False)
class Prediction:
    """A predicted quantity at a batch of states.

    Attributes:
        mean: `(*batch, d)`.
        covariance: `(*batch, d, d)`, of the noise-free quantity unless noise was asked for; `None` where the
            model gives none or it was not asked for.
        parts: the slice of each quantity, where several were asked for.
        beyond: `(*batch, nq)` how far the speed and torque of each joint lie beyond those of the training
            data, in training standard deviations; `None` for models that do not know.
        joint_names: the joints, in the order of `beyond`.
    """

    mean: Tensor
    covariance: Tensor | None = None
    parts: dict[str, slice] = field(default_factory=dict)
    beyond: Tensor | None = None
    joint_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse numbers that are not finite, and covariances that are none.

        Raises:
            NumericalError: the mean or the covariance is not finite, or an eigenvalue is clearly negative.
        """
        for name, value in (("mean", self.mean), ("covariance", self.covariance)):
            if value is not None and not bool(torch.isfinite(value).all()):
                raise NumericalError(
                    f"the {name} of a prediction is not finite",
                    got=f"{int((~torch.isfinite(value)).sum())} of {value.numel()} numbers",
                    hint="states beyond what a robot can do overflow; check q, qd and tau",
                )
        if self.covariance is not None:
            require_semidefinite(self.covariance)

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
        """Doubts about the prediction, each with a remedy: states far beyond the training data."""
        return () if self.beyond is None else warnings_beyond(self.beyond, self.joint_names)

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
            ParameterError: the number of axes is not that of the components.
        """
        from forcegp.models.measured import plot_prediction

        return plot_prediction(self.mean, self.std, tuple(self.parts), t, measured, names, ax)
