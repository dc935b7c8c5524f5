"""The dense posterior of latent forces in 80-bit arithmetic, from the textbook: a reference for rounding.

`numpy.longdouble` has a unit roundoff of 5e-20 on x86; elsewhere it may be float64, which is no reference.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from forcegp.data import Dataset
from forcegp.forces.problem import kernel_parameters
from forcegp.forces.quantities import affine_maps, states_at
from forcegp.gp.features import Block, Features, rows_of, stacked
from forcegp.gp.kernels import (
    Constant,
    Kernel,
    Linear,
    Matern32,
    Matern52,
    Parameters,
    Process,
    Product,
    SquaredExponential,
    Stationary,
    Sum,
    sub,
)
from forcegp.models.structured_fit import StructuredFit

Array = NDArray[np.longdouble]
PROFILES: dict[type[Stationary], Callable[[Array], Array]] = {
    SquaredExponential: lambda r2: np.exp(-r2 / 2),
    Matern32: lambda r2: (1 + np.sqrt(3 * r2)) * np.exp(-np.sqrt(3 * r2)),
    Matern52: lambda r2: (1 + np.sqrt(5 * r2) + 5 * r2 / 3) * np.exp(-np.sqrt(5 * r2)),
}


def is_extended() -> bool:
    """Whether this platform has more than double precision."""
    return np.finfo(np.longdouble).eps < 1e-18


def long(x: Tensor) -> Array:
    return x.detach().cpu().numpy().astype(np.longdouble)


def covariance(kernel: Kernel, params: Parameters, x1: Features, x2: Features) -> Array:
    """k(x, x′) `(components, n, n')`, entry by entry from differences of the inputs."""
    if isinstance(kernel, Sum):
        left = covariance(kernel.left, sub(params, "left"), x1, x2)
        right = covariance(kernel.right, sub(params, "right"), x1, x2)
        return left * right if isinstance(kernel, Product) else left + right
    a, b = (long(stacked(x, getattr(kernel, "inputs", None))) for x in (x1, x2))
    a, b = (x if x.ndim == 3 else x[None] for x in (a, b))
    if isinstance(kernel, Constant):
        scale = np.exp(2 * long(params["log_scale"])).repeat(kernel.group)[:, None, None]
        return scale * np.ones((1, a.shape[1], b.shape[1]), dtype=np.longdouble)
    if isinstance(kernel, Linear):
        slope = np.exp(long(params["log_slope_std"]))
        slope = slope * np.exp(long(params["log_std"]))[:, None] if kernel.shared else slope
        if kernel.offset is None:
            bias = np.exp(2 * long(params["log_bias_std"]))
        else:
            bias = np.exp(2 * long(params["log_offset"])) * (slope**2).mean(-1)
        return (a * slope[:, None] ** 2) @ np.swapaxes(b, 1, 2) + bias[:, None, None]
    assert isinstance(kernel, Stationary)
    scale = np.exp(-long(params["log_lengthscale"]))[:, None, :]
    apart = (a * scale)[:, :, None] - (b * scale)[:, None]
    variance = np.exp(2 * long(params["log_std"]))[:, None, None]
    return variance * PROFILES[type(kernel)]((apart**2).sum(-1))


def rows_covariance(
    processes: Sequence[Process], params: Parameters, one: Sequence[Block], two: Sequence[Block]
) -> Array:
    """Σ_k W k W′ᵀ between the rows of blocks."""
    whole = []
    for a in one:
        across = []
        for b in two:
            n, m, r, s = len(a.target), len(b.target), a.target.shape[1], b.target.shape[1]
            total = np.zeros((n, r, m, s), dtype=np.longdouble)
            for p, process in enumerate(processes):
                k = covariance(process.kernel, sub(params, process.prefix), a.features[p], b.features[p])
                V, W = long(a.operators[p]), long(b.operators[p])
                for c in range(k.shape[0]):
                    total += V[:, :, None, None, c] * k[c][:, None, :, None] * W[None, None, :, :, c]
            across.append(total.reshape(n * r, m * s))
        whole.append(np.concatenate(across, axis=1))
    return np.concatenate(whole, axis=0)


def cholesky(A: Array) -> Array:
    """Lower factor L of A = L Lᵀ."""
    L = np.zeros_like(A)
    for j in range(len(A)):
        column = A[j:, j] - L[j:, :j] @ L[j, :j]
        L[j:, j] = column / np.sqrt(column[0])
    return L


def forward(L: Array, B: Array) -> Array:
    """L⁻¹B."""
    X = np.zeros_like(B)
    for i in range(len(L)):
        X[i] = (B[i] - L[i, :i] @ X[:i]) / L[i, i]
    return X


def posterior(
    processes: Sequence[Process], params: Parameters, data: Sequence[Block], at: Block
) -> tuple[Array, Array, Array]:
    """Prior variance, posterior mean and posterior variance of rows at states, each `(n, d)`."""
    K = rows_covariance(processes, params, data, data)
    L = cholesky(K + np.eye(len(K), dtype=np.longdouble))
    V = forward(L, rows_covariance(processes, params, data, [at]))
    y = forward(L, np.concatenate([long(block.target).reshape(-1, 1) for block in data]))
    one = (rows_of(at, slice(i, i + 1)) for i in range(len(at.target)))
    prior = np.concatenate([np.diag(rows_covariance(processes, params, [own], [own])) for own in one])
    shape = tuple(at.target.shape)
    return prior.reshape(shape), (V.T @ y).reshape(shape), (prior - (V**2).sum(0)).reshape(shape)


def deviation_errors(fit: StructuredFit, at: Dataset, quantity: str = "qdd") -> float:
    """Largest relative error of a standard deviation of a fit where the prior has one.

    Args:
        fit: with exact inference, or priors with finitely many features.
        at: states.
        quantity: what is predicted.
    """
    states, _ = states_at(fit.system, at.q, at.qd, at.tau, at.active(fit.system.contact_names))
    rows = fit.posterior.rows(fit.system, states, affine_maps(fit.system, states, quantity)[0])
    problem, values = fit.problem.with_coulomb_errors(fit.hyperparameters)
    data, params = problem.rows(values).blocks, kernel_parameters(values)
    prior, _, variance = posterior(fit.posterior.priors, params, data, rows)
    found = fit.posterior.latent.covariance(rows).diagonal(dim1=-2, dim2=-1).numpy()
    known = prior > 0
    assert (variance[known] > 0).all() and (found[known] > 0).all()
    return float(np.abs(np.sqrt(found[known] / variance[known]) - 1).max())
