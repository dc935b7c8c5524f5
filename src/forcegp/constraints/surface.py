"""Rigid surfaces as implicit functions c(p), which are zero on the surface and positive outside the solid.

The gradient points out of the solid, so the multiplier of a contact under pressure is λ ≥ 0. For all surfaces
except `ImplicitSurface`, c is the signed distance and the gradient is the unit normal.

A class contains all that the library needs of a surface: c and its derivatives in PyTorch, the same on the
scalars of a program (`compiled/expression.py`), from which C code and CasADi functions are derived, and the
geometry in a simulation. The last two are optional.

`SurfaceSchema` describes surfaces in scene files and saved models, which are validated against these classes.
The field `type` selects the class.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from forcegp.errors import ParameterError
from forcegp.types import Scalars, Vector3

INFINITE = 100.0
"""Half-length of the solid that represents an infinite cylinder [m]."""


class Solid(NamedTuple):
    """A primitive geometry of MuJoCo that represents a surface.

    Attributes:
        shape: name of the primitive, such as `plane` or `sphere`.
        size: its three sizes [m], as MuJoCo defines them.
        position: its position in the world [m].
        axis: direction of its z axis in the world.
    """

    shape: str
    size: Sequence[float]
    position: Sequence[float]
    axis: Sequence[float] = (0.0, 0.0, 1.0)


class Surface(ABC):
    """A surface with the derivatives that a contact needs, evaluated at batches of points in the world."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        # What a class inherits describes another surface, if it has its own value.
        for name in ("scalars", "solid", "raised") if "value" in cls.__dict__ else ():
            if name not in cls.__dict__:
                setattr(cls, name, getattr(Surface, name))
        cls.has_scalars = cls.scalars is not Surface.scalars

    has_scalars = False
    """Whether the class defines `scalars` for its own `value`, so that contacts can be exported."""

    @abstractmethod
    def value(self, p: Vector3) -> Scalars:
        """Return c(p), `(*batch,)` [m if c is a signed distance]."""

    @abstractmethod
    def gradient(self, p: Vector3) -> Vector3:
        """Return ∇c(p), `(*batch, 3)`."""

    @abstractmethod
    def curvature(self, p: Vector3, v: Vector3) -> Scalars:
        """Return vᵀ ∇²c(p) v, `(*batch,)`."""

    def raised(self, distance: float) -> Surface:
        """Return the offset surface c(p) − distance; c must be a signed distance.

        Args:
            distance: offset along the normal [m].

        Raises:
            ParameterError: c is not a signed distance.
        """
        raise ParameterError(
            f"{type(self).__name__} cannot be offset by {distance} m",
            expected="a surface whose c is the signed distance",
            hint="define raised() in a subclass",
        )

    def scalars(self, p: np.ndarray, v: np.ndarray) -> tuple[Any, np.ndarray, Any]:
        """Return c, ∇c and vᵀ ∇²c v for the scalars of a program, which C and CasADi evaluate.

        Args:
            p, v: a point and its velocity, each a NumPy array `(3,)` of scalars.
        """
        raise NotImplementedError

    def solid(self) -> Solid | None:
        """Return the geometry that represents the surface in MuJoCo, or `None` if there is none."""
        return None


def _vector(values: Sequence[float], like: Tensor) -> Tensor:
    return torch.tensor(tuple(values), dtype=like.dtype, device=like.device)


def _unit(values: Sequence[float], what: str) -> tuple[float, ...]:
    length = math.hypot(*map(float, values))
    if len(values) != 3 or not 0.0 < length < float("inf"):
        raise ParameterError(
            f"{what} has no direction", expected="three finite numbers, not all zero", got=values
        )
    # A unit vector is not changed, so that a saved surface is restored bit for bit.
    scale = 1.0 if abs(length - 1.0) <= 1e-15 else length
    return tuple(float(x) / scale for x in values)


def check_point(values: Sequence[float], what: str) -> None:
    """Raise `ParameterError` unless the values are three finite coordinates."""
    if len(values) != 3 or not all(math.isfinite(x) for x in values):
        raise ParameterError(f"{what} is not a point", expected="three finite coordinates [m]", got=values)


@dataclass(frozen=True)
class Plane(Surface):
    """The plane c(p) = n·p − offset.

    Args:
        normal: direction that points out of the solid; it is normalized.
        offset: distance from the world origin along the normal [m].

    Example:
        >>> import torch
        >>> float(Plane(normal=(0, 0, 1), offset=0.5).value(torch.tensor([0.0, 0.0, 0.75])))
        0.25

    Raises:
        ParameterError: the normal is zero, or the offset is not finite.
    """

    normal: Sequence[float] = (0.0, 0.0, 1.0)
    offset: float = 0.0
    type: Literal["plane"] = field(default="plane", kw_only=True, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "normal", _unit(self.normal, "the plane's normal"))
        if not math.isfinite(self.offset):
            raise ParameterError(
                "the plane's offset is not a valid distance", expected="a finite number [m]", got=self.offset
            )

    def raised(self, distance: float) -> Plane:
        return replace(self, offset=self.offset + distance)

    def value(self, p: Vector3) -> Scalars:
        return p @ _vector(self.normal, p) - self.offset

    def gradient(self, p: Vector3) -> Vector3:
        return _vector(self.normal, p).expand_as(p)

    def curvature(self, p: Vector3, v: Vector3) -> Scalars:
        return torch.zeros_like(p[..., 0])

    def scalars(self, p: np.ndarray, v: np.ndarray) -> tuple[Any, np.ndarray, Any]:
        n = np.array(self.normal) + 0.0 * p
        return n @ p - self.offset, n, 0.0 * p[0]

    def solid(self) -> Solid:
        position = self.offset * np.array(self.normal)
        return Solid("plane", (0.0, 0.0, 1.0), position.tolist(), self.normal)


class _Round(Surface):
    """c(p) = |r| − radius, where `_across` computes r from p − center. Contact is from outside."""

    center: Sequence[float]
    radius: float

    def __post_init__(self) -> None:
        what = type(self).__name__.lower()
        check_point(self.center, f"the {what}'s center")
        object.__setattr__(self, "center", tuple(float(x) for x in self.center))
        if not 0.0 < self.radius < float("inf"):
            raise ParameterError(
                f"the {what}'s radius is not a valid length",
                expected="a positive finite number [m]",
                got=self.radius,
            )

    def _across(self, x: Any) -> Any:
        return x

    def raised(self, distance: float) -> Surface:
        return replace(self, radius=self.radius + distance)  # pyright: ignore[reportArgumentType]

    def value(self, p: Vector3) -> Scalars:
        r = self._across(p - _vector(self.center, p))
        return torch.linalg.vector_norm(r, dim=-1) - self.radius

    def gradient(self, p: Vector3) -> Vector3:
        return torch.nn.functional.normalize(self._across(p - _vector(self.center, p)), dim=-1)

    def curvature(self, p: Vector3, v: Vector3) -> Scalars:
        # vᵀ∇²c v = (|v|² − (rᵀv/|r|)²)/|r|
        r, v = self._across(p - _vector(self.center, p)), self._across(v)
        distance = torch.linalg.vector_norm(r, dim=-1)
        along = (r * v).sum(-1) / distance
        return ((v * v).sum(-1) - along**2) / distance

    def scalars(self, p: np.ndarray, v: np.ndarray) -> tuple[Any, np.ndarray, Any]:
        r, v = self._across(p - np.array(self.center)), self._across(v)
        distance = (r @ r).sqrt()
        n = r / distance
        along = n @ v
        return distance - self.radius, n, (v @ v - along * along) / distance


@dataclass(frozen=True)
class Sphere(_Round):
    """The sphere c(p) = |p − center| − radius, which is touched from outside.

    Args:
        center: centre of the sphere [m].
        radius: radius [m].

    Example:
        >>> import torch
        >>> float(Sphere(center=(0, 0, 0), radius=1.0).value(torch.tensor([0.0, 0.0, 3.0])))
        2.0

    Raises:
        ParameterError: the radius is not positive, or the centre is not a point.
    """

    center: Sequence[float]
    radius: float
    type: Literal["sphere"] = field(default="sphere", kw_only=True, repr=False)

    def solid(self) -> Solid:
        return Solid("sphere", (self.radius, 0.0, 0.0), self.center)


@dataclass(frozen=True)
class Cylinder(_Round):
    """The infinite cylinder c(p) = |p − center − a aᵀ(p − center)| − radius, which is touched from outside.

    Args:
        center: a point on the axis [m].
        axis: direction a of the axis; it is normalized.
        radius: radius [m].

    Example:
        >>> import torch
        >>> float(Cylinder(center=(0, 0, 0), axis=(0, 0, 1), radius=1.0).value(torch.tensor([3.0, 0.0, 7.0])))
        2.0

    Raises:
        ParameterError: the axis is zero, the radius is not positive, or the centre is not a point.
    """

    center: Sequence[float]
    axis: Sequence[float]
    radius: float
    type: Literal["cylinder"] = field(default="cylinder", kw_only=True, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "axis", _unit(self.axis, "the cylinder's axis"))

    def _across(self, x: Any) -> Any:
        # x − a aᵀx
        if isinstance(x, Tensor):
            a = _vector(self.axis, x)
            return x - (x @ a)[..., None] * a
        a = np.array(self.axis)
        return x - a * (x @ a)

    def solid(self) -> Solid:
        return Solid("cylinder", (self.radius, INFINITE, 0.0), self.center, self.axis)


SurfaceSchema = Annotated[Plane | Sphere | Cylinder, Field(discriminator="type")]
"""Surfaces in files, with `type = "plane"`, `"sphere"` or `"cylinder"`."""


@dataclass(frozen=True)
class ImplicitSurface(Surface):
    """Any smooth surface c(p), differentiated automatically.

    Args:
        function: function that maps one point `(3,)` to a scalar tensor. It must be positive outside the
            solid and twice differentiable. If |∇c| = 1, the multiplier is in newtons.

    Example:
        >>> import torch
        >>> bowl = ImplicitSurface(lambda p: p[2] - 0.5 * (p[0] ** 2 + p[1] ** 2))
        >>> bowl.gradient(torch.tensor([1.0, 0.0, 2.0]))
        tensor([-1.,  0.,  1.])
    """

    function: Callable[[Tensor], Tensor]

    def value(self, p: Vector3) -> Scalars:
        return torch.func.vmap(self.function)(p.reshape(-1, 3)).reshape(p.shape[:-1])

    def gradient(self, p: Vector3) -> Vector3:
        return torch.func.vmap(torch.func.grad(self.function))(p.reshape(-1, 3)).reshape(p.shape)

    def curvature(self, p: Vector3, v: Vector3) -> Scalars:
        def along(point: Tensor, direction: Tensor) -> Tensor:
            # vᵀ ∇²c v, with ∇²c v as the derivative of ∇c along v
            change = torch.func.jvp(torch.func.grad(self.function), (point,), (direction,))[1]
            return (change * direction).sum()

        flat = torch.func.vmap(along)(p.reshape(-1, 3), v.expand_as(p).reshape(-1, 3))
        return flat.reshape(p.shape[:-1])
