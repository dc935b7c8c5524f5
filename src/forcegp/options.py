"""Options of models, shared by constructors, the table `[model]` of scene files, and saved models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from forcegp.errors import ModelError, check_name
from forcegp.files import Record
from forcegp.gp.inducing import LIMIT

Width = Annotated[float, Field(ge=0.0, strict=True)]


class Window(Record):
    """Intervals from which initial values are drawn, centred on the parameters in the robot file.

    Attributes:
        relative: half-width for logarithms of masses, moments and friction. A value of 0.5 corresponds to a
            factor between 0.37 and 2.7 for the mass of a link, and between 0.61 and 1.65 for friction.
        length: half-width for centres of mass and other lengths [m].
        angle: half-width for rotations [rad].
    """

    relative: Width = 0.5
    length: Width = 0.05
    angle: Width = 0.1


@dataclass(frozen=True)
class Inference:
    """Inference about the forces of a `StructuredGP`.

    Args:
        method: `"exact"`, `"sparse"`, or `"auto"`, which depends on the priors and the number of samples.
        inducing_points: maximum number of inducing points per prior. Fewer points are used if they suffice.
            The result of the fit indicates whether more points would help.

    Example:
        >>> Inference("sparse", inducing_points=50).method
        'sparse'

    Raises:
        UnknownNameError: the method does not exist.
        ModelError: the number of points is not a positive integer.
    """

    method: Literal["auto", "exact", "sparse"] = "auto"
    inducing_points: int = LIMIT

    def __post_init__(self) -> None:
        check_name("inference", self.method, ("auto", "exact", "sparse"))
        points = self.inducing_points
        if isinstance(points, bool) or not isinstance(points, int) or points < 1:
            raise ModelError("invalid `inducing_points`", expected="an integer greater than 0", got=points)
