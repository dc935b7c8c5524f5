"""Standard deviations of learned robot parameters θ_A, from the curvature of the likelihood.

At given kernels and noise, the posterior of the coordinates x of θ_A is approximately Gaussian (Laplace). The
forces are marginalised:

    Σ = (∂²/∂x² [−κ log p(y | x)])⁻¹,  σ² = diag J Σ Jᵀ,  J = ∂θ_A/∂x.

Source: Rasmussen and Williams, *Gaussian Processes for Machine Learning* (2006), section 3.4.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.forces.priors.base import ANALYTICAL
from forcegp.forces.problem import Problem, kernel_parameters
from forcegp.robot.model import RobotModel
from forcegp.robot.parameters import AnalyticalParameters

STEP = 1e-4
"""Step of the differences of the gradient, in logarithms, metres or radians."""
LEAST = 1e-9
"""Relative curvature below which a direction is undetermined, and part of a parameter that counts as none."""
FIELDS = {"inertia": ("mass", "com", "inertia"), "offset": ("placement_rotation", "placement_position")}
"""Fields of the robot that a learned quantity changes, if they are not the quantity itself."""


def parameter_std(problem: Problem, hyperparameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return σ of every robot parameter that was learned; see `StructuredFit.parameter_std`."""
    theta = problem.parameters
    if not isinstance(theta, AnalyticalParameters) or not problem.training.samples:
        text = "the fit has no robot parameters with standard deviations"
        hint = (
            "pass analytical_parameters, and keep the fit, since sparse models are saved without their data"
        )
        raise ModelError(text, expected="learned robot parameters, and their training data", hint=hint)
    places = {f"{ANALYTICAL}.{name}": value.detach() for name, value in theta.named_parameters()}
    places |= {name: hyperparameters[name] for name in places if name in hyperparameters}
    sizes = [value.numel() for value in places.values()]

    def named(x: Tensor) -> dict[str, Tensor]:
        parts = zip(places.items(), x.split(sizes), strict=True)
        return {name: part.view_as(value) for (name, value), part in parts}

    def gradient(x: Tensor) -> Tensor:
        leaf = x.detach().requires_grad_()
        tensors = {**hyperparameters, **named(leaf)}
        rows = problem.rows(tensors)
        with torch.enable_grad():
            value = problem.negative_log_likelihood(kernel_parameters(tensors), rows)
        return torch.autograd.grad(value, leaf)[0]

    def robot(x: Tensor) -> RobotModel:
        values = {name.removeprefix(f"{ANALYTICAL}."): value for name, value in named(x).items()}
        return torch.func.functional_call(theta, values, ())

    x = torch.cat([value.flatten() for value in places.values()])
    steps = STEP * torch.eye(len(x)).to(x)
    H = torch.stack([gradient(x + step) - gradient(x - step) for step in steps]) / (2.0 * STEP)
    w, V = torch.linalg.eigh(0.5 * (H + H.mT))
    known = w > LEAST * w.max().clamp(min=1e-300)
    std = {}
    for field in dict.fromkeys(
        name for quantity in theta.joints for name in FIELDS.get(quantity, (quantity,))
    ):
        J = torch.autograd.functional.jacobian(lambda y, field=field: getattr(robot(y), field), x)
        # H = V diag(w) Vᵀ, σ² = Σ_k (J V)_k² / w_k
        along = (J @ V).square()
        variance = (along[..., known] / w[known]).sum(-1)
        lost = along[..., ~known].sum(-1) > LEAST * along.sum(-1)
        std[field] = variance.sqrt().masked_fill(lost, torch.inf)
    return std
