"""Weights of basis functions that drift: a component that changes while the others stay.

A drifting weight is an Ornstein–Uhlenbeck process with its prior as stationary distribution,
w′ = ρ w + √(1 − ρ²) ξ, ξ ~ N(0, I). In information form, with A = I + G, v and the drifting weights p,

    S = A_pp + ρ²a I,  a = 1/(1 − ρ²),
    A′_oo = A_oo − A_op S⁻¹ A_po,  A′_op = ρa A_op S⁻¹,  A′_pp = a I − ρ²a² S⁻¹,
    v′_o = v_o − A_op S⁻¹ v_p,  v′_p = ρa S⁻¹ v_p.
"""

from __future__ import annotations

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.gp.sums import Sums


def drifted(sums: Sums, weights: Tensor, factor: float) -> Sums:
    """The sums after some weights have drifted; predictions of the others stay as they are.

    Args:
        sums: over the samples so far.
        weights: positions of the weights that drift `(k,)`.
        factor: ρ, their correlation with what they were: 1 keeps them, 0 returns them to their prior.

    Raises:
        ModelError: the factor is not between 0 and 1.
    """
    if not 0.0 <= factor <= 1.0:
        raise ModelError("invalid forgetting factor", expected="from 0 to 1", got=factor)
    if factor == 1.0 or not len(weights):
        return sums
    a, p = 1.0 / (1.0 - factor**2), weights
    A = sums.G + torch.eye(len(sums.G), dtype=sums.G.dtype, device=sums.G.device)
    eye = torch.eye(len(p), dtype=A.dtype, device=A.device)
    L = torch.linalg.cholesky(A[p][:, p] + factor**2 * a * eye)
    inverse = torch.cholesky_inverse(L)
    A_ap, gain = A[:, p], A[:, p] @ inverse
    G, v = sums.G - gain @ A_ap.mT, sums.v - gain @ sums.v[p]
    G[:, p] = factor * a * gain
    G[p, :] = G[:, p].mT
    G[p[:, None], p[None, :]] = a * eye - (factor * a) ** 2 * inverse - eye
    v[p] = factor * a * (inverse @ sums.v[p])
    yy = sums.yy - sums.v[p] @ (inverse @ sums.v[p])
    return Sums(v, yy, sums.rows, sums.prior, sums.missed, G)
