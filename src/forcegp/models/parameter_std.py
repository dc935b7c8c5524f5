"""Standard deviations of learned robot parameters θ_A, from the curvature of the likelihood.

At given kernels and noise, the posterior of the coordinates x of θ_A is approximately Gaussian (Laplace). The
forces are marginalised:

    Σ = (∂²/∂x² [−κ log p(y | x)])⁻¹,  σ² = diag J Σ Jᵀ,  J = ∂θ_A/∂x.

Source: Rasmussen and Williams, *Gaussian Processes for Machine Learning* (2006), section 3.4.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from forcegp.errors import ModelError, NumericalError
from forcegp.forces.priors.base import ANALYTICAL
from forcegp.forces.problem import kernel_parameters
from forcegp.robot.model import RobotModel
from forcegp.robot.parameters import AnalyticalParameters

if TYPE_CHECKING:
    from forcegp.models.structured_fit import StructuredFit

STEP = 1e-4
"""Step of the differences of the gradient, in logarithms, metres or radians."""
FIELDS = {"inertia": ("mass", "com", "inertia"), "offset": ("placement_rotation", "placement_position")}
"""Fields of the robot that a learned quantity changes, if they are not the quantity itself."""


def parameter_std(fit: StructuredFit) -> dict[str, Tensor]:
    """Return σ of every robot parameter that was learned; see `StructuredFit.parameter_std`."""
    theta = fit.problem.parameters
    if not isinstance(theta, AnalyticalParameters) or not fit.training.samples:
        text = "the fit has no robot parameters with standard deviations"
        hint = (
            "pass analytical_parameters, and keep the fit, since sparse models are saved without their data"
        )
        raise ModelError(text, expected="learned robot parameters, and their training data", hint=hint)
    places = {f"{ANALYTICAL}.{name}": value.detach() for name, value in theta.named_parameters()}
    places |= {name: fit.hyperparameters[name] for name in places if name in fit.hyperparameters}
    sizes = [value.numel() for value in places.values()]

    def named(x: Tensor) -> dict[str, Tensor]:
        parts = zip(places.items(), x.split(sizes), strict=True)
        return {name: part.view_as(value) for (name, value), part in parts}

    def gradient(x: Tensor) -> Tensor:
        leaf = x.detach().requires_grad_()
        tensors = {**fit.hyperparameters, **named(leaf)}
        rows = fit.problem.rows(tensors)
        with torch.enable_grad():
            value = fit.problem.negative_log_likelihood(kernel_parameters(tensors), rows)
        return torch.autograd.grad(value, leaf)[0]

    def robot(x: Tensor) -> RobotModel:
        own = {name.removeprefix(f"{ANALYTICAL}."): value for name, value in named(x).items()}
        return torch.func.functional_call(theta, own, ())

    x = torch.cat([value.flatten() for value in places.values()])
    steps = STEP * torch.eye(len(x)).to(x)
    H = torch.stack([gradient(x + step) - gradient(x - step) for step in steps]) / (2.0 * STEP)
    L, info = torch.linalg.cholesky_ex(0.5 * (H + H.mT))
    if bool(info):
        text = "the training data do not determine all robot parameters"
        raise NumericalError(text, hint="learn fewer of them, or record a motion that excites them")
    found = {}
    for field in dict.fromkeys(
        name for quantity in theta.joints for name in FIELDS.get(quantity, (quantity,))
    ):
        J = torch.autograd.functional.jacobian(lambda y, field=field: getattr(robot(y), field), x)
        # σ² = Σ_k (J L⁻ᵀ)²
        half = torch.linalg.solve_triangular(L, J.flatten(0, -2).mT, upper=False)
        found[field] = half.square().sum(0).sqrt().view(J.shape[:-1])
    return found
