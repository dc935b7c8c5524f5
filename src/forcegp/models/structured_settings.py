"""Structured Gaussian processes as settings and tensors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, PositiveFloat

from forcegp.errors import ModelError
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.contact import ContactForcePrior, SlidingFrictionPrior, SurfaceForcePrior
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.forces.priors.normal_force import NormalForcePrior
from forcegp.gp import kernels, stationary
from forcegp.models.base import not_fitted
from forcegp.storage.folder import Settings, write_model

if TYPE_CHECKING:
    from forcegp.models.structured_gp import StructuredGP

STATIONARY = {
    "squared_exponential": stationary.SquaredExponential,
    "matern32": stationary.Matern32,
    "matern52": stationary.Matern52,
}
PAIRS = {"sum": kernels.Sum, "product": kernels.Product}
COLUMNS = ("q", "qd", "tau", "active", "values")


class StationaryKernel(Settings):
    """A kernel of the scaled distance."""

    type: Literal["squared_exponential", "matern32", "matern52"]
    inputs: tuple[str, ...] | None
    shared: bool = False

    def build(self) -> kernels.Kernel:
        return STATIONARY[self.type](self.inputs, self.shared)


class LinearKernel(Settings):
    """A linear kernel."""

    type: Literal["linear"] = "linear"
    inputs: tuple[str, ...] | None
    ard: bool = True
    shared: bool = False

    def build(self) -> kernels.Kernel:
        return kernels.Linear(self.inputs, self.ard, self.shared)


class PairKernel(Settings):
    """A kernel of two others."""

    type: Literal["sum", "product"]
    left: KernelSettings
    right: KernelSettings

    def build(self) -> kernels.Kernel:
        return PAIRS[self.type](self.left.build(), self.right.build())


KernelSettings = Annotated[StationaryKernel | LinearKernel | PairKernel, Field(discriminator="type")]
PairKernel.model_rebuild()


class JointPrior(Settings):
    """A `JointForcePrior`."""

    type: Literal["joint"] = "joint"
    name: str
    kernel: KernelSettings
    inputs: tuple[str, ...]
    periodic: bool

    def build(self) -> ForcePrior:
        return JointForcePrior(self.kernel.build(), self.inputs, self.periodic, self.name)


class SurfacePrior(Settings):
    """What priors on the force at a contact with a surface share."""

    name: str
    contact: str
    kernel: KernelSettings
    inputs: tuple[str, ...]


class ContactPrior(SurfacePrior):
    """A `ContactForcePrior`."""

    type: Literal["contact"] = "contact"

    def build(self) -> ForcePrior:
        return ContactForcePrior(self.contact, self.kernel.build(), self.inputs, self.name)


class SlidingPrior(SurfacePrior):
    """A `SlidingFrictionPrior`."""

    type: Literal["sliding_friction"] = "sliding_friction"
    smoothing: float

    def build(self) -> ForcePrior:
        kernel, smoothing = self.kernel.build(), self.smoothing
        return SlidingFrictionPrior(self.contact, kernel, self.inputs, self.name, smoothing=smoothing)


class NormalPrior(Settings):
    """A `NormalForcePrior`."""

    type: Literal["normal"] = "normal"
    like: JointPrior

    def build(self) -> ForcePrior:
        like = self.like
        return NormalForcePrior(JointForcePrior(like.kernel.build(), like.inputs, like.periodic, like.name))


PriorSettings = JointPrior | ContactPrior | SlidingPrior | NormalPrior


class StructuredSettings(Settings):
    """What is kept of a structured Gaussian process beside its tensors."""

    mean: tuple[str, ...]
    noise_std: PositiveFloat | tuple[PositiveFloat, ...]
    learn_noise: bool
    priors: tuple[Annotated[PriorSettings, Field(discriminator="type")], ...]
    measured: tuple[str, ...]
    constant: tuple[tuple[str, ...], ...]


def _kernel_settings(kernel: kernels.Kernel) -> StationaryKernel | LinearKernel | PairKernel:
    if isinstance(kernel, kernels.Sum):
        left, right = _kernel_settings(kernel.left), _kernel_settings(kernel.right)
        return PairKernel(
            type="product" if isinstance(kernel, kernels.Product) else "sum", left=left, right=right
        )
    if type(kernel) is kernels.Linear:
        return LinearKernel(inputs=kernel.inputs, ard=kernel.ard, shared=kernel.shared)
    for name, kind in STATIONARY.items():
        if type(kernel) is kind:
            inputs, shared = getattr(kernel, "inputs"), getattr(kernel, "shared")  # noqa: B009
            return StationaryKernel(type=name, inputs=inputs, shared=shared)  # pyright: ignore[reportArgumentType]
    raise ModelError(
        f"a kernel of type {type(kernel).__name__} cannot be saved",
        expected=", ".join([*STATIONARY, "linear", *PAIRS]),
    )


def _joint_settings(prior: JointForcePrior) -> JointPrior:
    kernel = _kernel_settings(prior.kernel)
    return JointPrior(name=prior.name, kernel=kernel, inputs=prior.inputs, periodic=prior.periodic)


def _prior_settings(prior: ForcePrior) -> PriorSettings:
    kernel = _kernel_settings(prior.kernel)
    if type(prior) is JointForcePrior:
        return _joint_settings(prior)
    if type(prior) is NormalForcePrior:
        return NormalPrior(like=_joint_settings(prior.like))
    if isinstance(prior, SurfaceForcePrior):
        shared = {"name": prior.name, "contact": prior.contact, "kernel": kernel, "inputs": prior.inputs}
        if type(prior) is ContactForcePrior:
            return ContactPrior(**shared)
        if type(prior) is SlidingFrictionPrior:
            return SlidingPrior(**shared, smoothing=prior.smoothing)
    raise ModelError(
        f"force prior {prior.name!r} of type {type(prior).__name__} holds Python code and cannot be saved",
        expected="JointForcePrior, NormalForcePrior, ContactForcePrior or SlidingFrictionPrior",
    )


def save_structured(model: StructuredGP, path: str | Path) -> None:
    """Write a fitted model; where θ_A was learned, the robot that is kept is the learned one.

    Raises:
        ModelError: the model has not been fitted, or a prior or kernel of it is Python code.
    """
    if model.training is None:
        raise not_fitted(model)
    noise = model.noise_std
    settings = StructuredSettings(
        mean=model.mean.terms,
        noise_std=float(noise) if isinstance(noise, int | float) else tuple(float(x) for x in noise),
        learn_noise=model.learn_noise,
        priors=tuple(_prior_settings(prior) for prior in model.force_priors),
        measured=tuple(m.quantity for m in model.training.measurements),
        constant=tuple(scale.constant for scale in model.training.scales),
    )
    tensors = {f"hyper.{key}": value for key, value in model.hyperparameters.items()}
    tensors["alpha"] = model.posterior.alpha
    for i, (m, std) in enumerate(zip(model.training.measurements, model.training.noise_std, strict=True)):
        tensors |= {f"data.{i}.{name}": getattr(m, name) for name in COLUMNS}
        tensors[f"data.{i}.noise_std"] = std
    for prior, scale in zip(model.force_priors, model.training.scales, strict=True):
        tensors |= {f"scale.{prior.name}.mean.{key}": value for key, value in scale.mean.items()}
        tensors |= {f"scale.{prior.name}.std.{key}": value for key, value in scale.std.items()}
    write_model(path, model.kind, model.system, settings, tensors)
