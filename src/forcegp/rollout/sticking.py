"""Joints that stick and slide: dry friction as a complementarity problem over a step.

Over a step h, dry friction p of the joints changes the velocity to q̇⁺ = q̇ + h (q̈₀ + G p), with q̈₀ the
acceleration without it. It opposes motion as much as it can: |p_i| ≤ F_i, p_i = −F_i sign(q̇⁺_i) where the
joint slides, and anything within the limit where it is at rest (Moreau; Stewart and Trinkle, *An implicit
time-stepping scheme for rigid body dynamics with inelastic collisions and Coulomb friction*, 1996). In
contact G = H, so that the contact's force answers to that of joints that stick.

The problem is solved exactly by block principal pivoting (Júdice and Pires, *A block principal pivoting
algorithm for large-scale strictly monotone linear complementarity problems*, 1994): guess which joints stick,
solve for their friction, exchange those that contradict the guess.

Light joints with much viscous friction D are stiff: where h G_ii D_i > 1, an explicit step turns their
motion round, and above 2 it grows without end. There viscous friction is that at the end of the step,
q̈ = q̈₀ + G (p − h D q̈), as in MuJoCo's Euler integrator; elsewhere it is that of the start.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.errors import NumericalError

REGULARIZATION = 1e-10
"""Compliance of sticking, relative to that of a free joint. In contact more joints can stick than can move,
and only with it is their friction unique; it lets them creep by this part of the motion without friction."""
CONTRADICTION = 1e-9
"""A force beyond its limit, or a velocity against its direction, counts from this on, relative to its
scale."""
BLOCK_TRIALS = 5
"""Exchanges of several joints at once that may fail to improve the guess, before single ones."""
MAX_EXCHANGES = 300
"""Exchanges in all; arms need fewer than ten."""
INSTANT = 1e-12
"""Shortest step, at which a joint that moves slides [s]."""
STILL = 1e-8
"""Speed up to which a joint is at rest: joints that stick creep by rounding [rad/s, m/s]."""


class Stuck(NamedTuple):
    """Dry friction over a step.

    Attributes:
        force: p `(n, nq)` [N m, N].
        held: `(n, nq)` bool, joints at rest at the end of the step.
        stopping: `(n, nq)` acceleration with which a joint comes to rest at the end of the step.
    """

    force: Tensor
    held: Tensor
    stopping: Tensor


def overshooting(G: Tensor, damping: Tensor, h: Tensor) -> Tensor | None:
    """The viscous friction D `(n, nq)` of states where it would turn a joint round within the step.

    Args:
        G: `(n, nq, nq)` acceleration per joint force.
        damping: `(n, nq)` D ≥ 0 [N m s/rad, N s/m].
        h: `(n, 1)` step [s].

    Returns:
        D where h G_ii D_i > 1 for a joint of the state and 0 elsewhere; `None` where no state has one.
    """
    rows = (h * G.diagonal(dim1=-2, dim2=-1) * damping > 1.0).any(-1, keepdim=True)
    return torch.where(rows, damping, 0.0) if bool(rows.any()) else None


def at_the_end(qdd: Tensor, G: Tensor, damping: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """Acceleration and its response to joint forces with viscous friction at the end of a step.

    q̈ = q̈₀ + G (p − h D q̈), so q̈ = (1 + h G D)⁻¹ (q̈₀ + G p).

    Args:
        qdd: `(n, nq)` q̈₀, with viscous friction at the start of the step [rad/s², m/s²].
        G: `(n, nq, nq)` acceleration per joint force p.
        damping: `(n, nq)` D ≥ 0 [N m s/rad, N s/m].
        h: `(n, 1)` step [s].

    Returns:
        (1 + h G D)⁻¹ q̈₀ and (1 + h G D)⁻¹ G.

    Example:
        >>> import torch
        >>> one = torch.ones(1, 1, dtype=torch.float64)
        >>> qdd, _ = at_the_end(-2.0 * one, one[None], 3.0 * one, one)
        >>> qdd.item()
        -0.5
    """
    slowed = torch.eye(G.shape[-1], dtype=G.dtype, device=G.device) + G * (h * damping)[..., None, :]
    both = torch.linalg.solve(slowed, torch.cat([qdd[..., None], G], dim=-1))
    return both[..., 0], both[..., 1:]


def dry_friction_force(qdd: Tensor, G: Tensor, limit: Tensor, qd: Tensor, h: Tensor) -> Stuck:
    """The dry friction of joints over a step.

    Args:
        qdd: `(n, nq)` acceleration without it [rad/s², m/s²].
        G: `(n, nq, nq)` acceleration per dry friction, H or M⁻¹.
        limit: `(n, nq)` its largest size F ≥ 0 [N m, N].
        qd: `(n, nq)` velocity at the start of the step [rad/s, m/s].
        h: `(n, 1)` step; 0 for an instant [s].

    Raises:
        NumericalError: no friction solves the problem, since G is not positive definite.

    Example:
        >>> import torch
        >>> one = torch.ones(1, 1, dtype=torch.float64)
        >>> round(dry_friction_force(3.0 * one, one[None], 5.0 * one, 0.0 * one, one).force.item(), 6)
        -3.0
    """
    stopping = -torch.where(qd.abs() > STILL, qd, 0.0) / h.clamp(min=INSTANT)
    free = qdd - stopping
    own = G.diagonal(dim1=-2, dim2=-1)
    compliance = own.clamp(min=1e-3 * own.amax(-1, keepdim=True))
    G = G + torch.diag_embed(REGULARIZATION * compliance)
    slack_force = CONTRADICTION * (limit + (free / compliance).abs())
    slack_motion = CONTRADICTION * (free.abs() + compliance * limit)
    eye = torch.eye(G.shape[-1], dtype=G.dtype, device=G.device).expand_as(G)
    # 0 for a joint that sticks, ±1 for one that slides.
    direction = torch.where(limit > 0.0, 0.0, free.sign())
    fewest = torch.full((len(G),), G.shape[-1] + 1, device=G.device)
    trials = torch.full_like(fewest, BLOCK_TRIALS)
    count = fewest
    for _ in range(MAX_EXCHANGES):
        sticks = (direction == 0.0)[..., None]
        system = torch.where(sticks, G, eye)
        known = torch.where(sticks[..., 0], -free, -direction * limit)
        force = torch.linalg.solve(system, known[..., None])[..., 0]
        motion = free + (G @ force[..., None])[..., 0]
        over = torch.where(sticks[..., 0] & (force.abs() > limit + slack_force), -force.sign(), 0.0)
        back = (direction * motion < -slack_motion) & ~sticks[..., 0]
        wrong = (over != 0.0) | back
        count = wrong.sum(-1)
        if not bool(count.any()):
            return Stuck(force, sticks[..., 0], stopping)
        better = count < fewest
        fewest = torch.where(better, count, fewest)
        trials = torch.where(better, BLOCK_TRIALS, trials - 1)
        last = wrong & (wrong.flip(-1).cumsum(-1).flip(-1) == 1)
        exchanged = torch.where((trials >= 0)[:, None], wrong, last)
        direction = torch.where(exchanged, over, direction)
    raise NumericalError(
        "the dry friction of the joints cannot be found",
        got=f"{int(count.count_nonzero())} of {len(G)} states without a solution",
        hint="a smaller step, or RolloutOptions(sticking=False)",
    )
