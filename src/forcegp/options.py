"""Options of models, shared by constructors, the table `[model]` of scene files, and saved models."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, PositiveInt, ValidationError

from forcegp.errors import ModelError, UnknownNameError
from forcegp.files import Record
from forcegp.gp.inducing import LIMIT

Width = Annotated[float, Field(ge=0.0, strict=True)]
O = TypeVar("O", bound="KernelOptions")


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


class KernelOptions(Record):
    """Options of models with kernels that depend on the state.

    Attributes:
        standardize: whether to standardize kernel inputs, which the paper does not do.
    """

    standardize: bool = True

    @classmethod
    def of(cls: type[O], values: Mapping[str, Any]) -> O:
        """Return the options in a mapping, after checking their types.

        Raises:
            UnknownNameError: a value is not one of the names allowed for its field.
            ModelError: a value is invalid.
        """
        known = {name: values[name] for name in cls.model_fields if name in values}
        try:
            return cls.model_validate(known, strict=True)
        except ValidationError as cause:
            first = cause.errors()[0]
            name = str(first["loc"][0])
            if first["type"] == "literal_error":
                names = re.findall(r"'([^']*)'", first["msg"])
                raise UnknownNameError(name, values[name], names) from cause
            raise ModelError(f"invalid `{name}`", expected=first["msg"], got=values[name]) from cause


class StructuredOptions(KernelOptions):
    """Options of `StructuredGP` with plain values.

    Each field is also a constructor argument, a key of `[model]` and a setting of saved models. The fields
    are repeated only in the constructor signature.

    Attributes:
        inference: the type of inference. `"auto"` chooses it according to the number of samples.
        inducing_points: maximum number of inducing points per prior.
        inertia: `"file"`, or `"auto"` to identify the inertia if the log supports it. `None` means `"auto"`
            if priors are selected automatically, and `"file"` otherwise.
    """

    inference: Literal["auto", "exact", "sparse"] = "auto"
    inducing_points: PositiveInt = LIMIT
    inertia: Literal["file", "auto"] | None = None
