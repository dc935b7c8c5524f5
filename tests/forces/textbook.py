"""The textbook Gaussian process in nq·N (or more) rows: eqs. 10, 11 and 22 to 24 written down as they stand.

Kernels are built from differences of inputs, covariances with one einsum as in the paper, the posterior
with a dense solve. Slow, and independent of the projected, whitened, chunked implementation.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.quantities import affine_map, states
from forcegp.gp.kernels import Kernel, Linear, Product, SquaredExponential, Stationary, Sum, sub
from forcegp.models.structured_fit import StructuredFit


def covariance(kernel: Kernel, params: dict[str, Tensor], x1: dict, x2: dict) -> Tensor:
    """`(k, n, n')` of squared exponentials and linear kernels, their sums and products (remark 3.2)."""
    if isinstance(kernel, Sum):
        left = covariance(kernel.left, sub(params, "left"), x1, x2)
        right = covariance(kernel.right, sub(params, "right"), x1, x2)
        return left * right if isinstance(kernel, Product) else left + right
    assert isinstance(kernel, Linear | Stationary)
    a, b = (torch.cat([x[name] for name in kernel.inputs or tuple(x)], dim=-1) for x in (x1, x2))
    if a.ndim == 3:  # Each component has inputs of its own.
        one = [
            covariance(kernel, _of_component(params, k), {"x": a[:, k]}, {"x": b[:, k]})
            for k in range(a.shape[1])
        ]
        return torch.cat(one)
    if isinstance(kernel, Linear):
        slopes = params["log_slope_std"].exp() ** 2
        if kernel.shared:
            slopes = params["log_std"].exp()[:, None] ** 2 * slopes
        if kernel.offset is None:
            bias = params["log_bias_std"].exp() ** 2
        else:
            bias = params["log_offset"].exp() ** 2 * slopes.mean(-1)
        return torch.einsum("kd,nd,md->knm", slopes.expand(-1, a.shape[-1]), a, b) + bias[:, None, None]
    assert isinstance(kernel, SquaredExponential)
    return squared_exponential(params, a, b)


def _of_component(params: dict[str, Tensor], k: int) -> dict[str, Tensor]:
    """The hyperparameters of one component, and those that all of them share."""
    return {name: v if len(v) == 1 else v[k : k + 1] for name, v in params.items()}


def squared_exponential(params: dict[str, Tensor], x1: Tensor, x2: Tensor) -> Tensor:
    """`(k, n, n')` from explicit differences."""
    difference = (x1[None, :, None, :] - x2[None, None, :, :]) / params["log_lengthscale"].exp()[
        :, None, None
    ]
    return params["log_std"].exp()[:, None, None] ** 2 * torch.exp(-0.5 * (difference**2).sum(-1))


class Textbook:
    """A dense Gaussian process over several quantities with the hyperparameters of a fitted model."""

    def __init__(
        self,
        model: StructuredFit,
        params: dict[str, Tensor] | None = None,
        system: ConstrainedSystem | None = None,
    ) -> None:
        self.model, self.params = model, params or model.hyperparameters
        self.system = system or model.system

    def _inputs(self, at: object, p: int) -> dict[str, Tensor]:
        prior, scale = self.model.force_priors[p], self.model.training.scales[p]
        return scale.apply(prior.features(self.system, at))

    def _maps(self, q: Tensor, qd: Tensor, tau: Tensor, active: Tensor, quantity: str) -> tuple:
        system = self.system
        at = states(system, q, qd, tau, active)
        z = affine_map(system, at, quantity)
        mean = z.o + torch.einsum("nab,nb->na", z.B_Q, self.model.problem.mean(system, at))
        operators, inputs = [], []
        for p, prior in enumerate(self.model.force_priors):
            B = z.B_z if prior.target == "contact" else z.B_Q
            operators.append(B @ prior.operator(system, at))
            inputs.append(self._inputs(at, p))
        return mean, operators, inputs

    def _covariance(self, one: tuple, two: tuple) -> Tensor:
        total = torch.zeros(())
        for p, prior in enumerate(self.model.force_priors):
            k = covariance(prior.kernel, sub(self.params, prior.prefix), one[2][p], two[2][p])
            kQ = torch.diag_embed(k.permute(1, 2, 0))
            total = total + torch.einsum("iab,ijbc,jdc->iajd", one[1][p], kQ, two[1][p])
        n, a, m, d = total.shape
        return total.reshape(n * a, m * d)

    def data(self) -> tuple[Tensor, Tensor, list[tuple]]:
        """Residual `(rows,)`, noise variance `(rows,)`, and the maps of each measurement."""
        maps, residual, noise = [], [], []
        training = self.model.training
        for i, (m, given) in enumerate(zip(training.measurements, training.noise_std, strict=True)):
            learned = self.params.get(f"noise.{i}.log_noise_std")
            std = given if learned is None else learned.exp()
            maps.append(self._maps(m.q, m.qd, m.tau, m.active, m.quantity))
            residual.append((m.values - maps[-1][0]).reshape(-1))
            noise.append((std**2).expand_as(m.values).reshape(-1))
        return torch.cat(residual), torch.cat(noise), maps

    def gram(self, maps: list[tuple]) -> Tensor:
        return torch.cat([torch.cat([self._covariance(i, j) for j in maps], dim=1) for i in maps], dim=0)

    def negative_log_likelihood(self) -> Tensor:
        y, noise, maps = self.data()
        L = torch.linalg.cholesky(self.gram(maps) + torch.diag(noise))
        alpha = torch.cholesky_solve(y[:, None], L)[:, 0]
        return 0.5 * y @ alpha + L.diagonal().log().sum() + 0.5 * len(y) * math.log(2 * math.pi)

    def predict(
        self, q: Tensor, qd: Tensor, tau: Tensor, active: Tensor, quantity: str
    ) -> tuple[Tensor, Tensor]:
        y, noise, maps = self.data()
        K = self.gram(maps) + torch.diag(noise)
        test = self._maps(q, qd, tau, active, quantity)
        cross = torch.cat([self._covariance(test, m) for m in maps], dim=1)
        mean = test[0] + (cross @ torch.linalg.solve(K, y)).reshape(test[0].shape)
        full = self._covariance(test, test) - cross @ torch.linalg.solve(K, cross.mT)
        n, d = test[0].shape
        blocks = full.reshape(n, d, n, d)
        return mean, torch.stack([blocks[i, :, i] for i in range(n)])
