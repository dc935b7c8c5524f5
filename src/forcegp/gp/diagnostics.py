"""What a sparse posterior loses by its inducing points."""

from __future__ import annotations

from dataclasses import dataclass

MISSED = 0.1
"""Missed variance, as a fraction of what the noise leaves, above which more points would help."""


@dataclass(frozen=True)
class Diagnostics:
    """What a sparse posterior loses by its inducing points.

    Attributes:
        size: number of basis functions.
        rows: number of rows, less what is forgotten.
        learned: how many basis functions the rows determine, tr A⁻¹G; in units of the noise variance this is
            the variance that noise leaves in all rows together.
        missed: the prior variance that the points miss in all rows together, in the same units.
        relative: missed prior variance of each process as a fraction of all of it.
        residual: mean square of the rows' residuals, 1 where the model and its noise fit.
    """

    size: int
    rows: float
    learned: float
    missed: float
    relative: tuple[float, ...]
    residual: float

    @property
    def more_points_would_help(self) -> bool:
        """Whether the points miss a tenth or more of the variance that the noise leaves."""
        return self.missed > MISSED * self.learned
