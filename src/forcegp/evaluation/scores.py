"""Errors of predicted accelerations: by joint, in acceleration and in torque, moving and at rest."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

REST = 0.02
"""A joint rests below this share of its fast (95 % quantile) speed in the data, ..."""
SLOWEST = 5e-3
"""... and always below this speed [rad/s, m/s], so that the noise of a resting joint is not motion."""
FEWEST = 10
"""Minimum number of samples for an error in a condition."""


@dataclass(frozen=True)
class Errors:
    """Differences between predicted and given accelerations [rad/s², m/s²].

    Attributes:
        mae: mean absolute error over samples and joints.
        rmse: root-mean-square error over samples and joints.
        mae_by_joint, rmse_by_joint: the same, one per joint.
    """

    mae: float
    rmse: float
    mae_by_joint: tuple[float, ...]
    rmse_by_joint: tuple[float, ...]

    @classmethod
    def of(cls, error: Tensor) -> Errors:
        """From differences `(n, nq)`."""
        return cls(
            mae=float(error.abs().mean()),
            rmse=float((error**2).mean().sqrt()),
            mae_by_joint=tuple(error.abs().mean(0).tolist()),
            rmse_by_joint=tuple((error**2).mean(0).sqrt().tolist()),
        )


ByJoint = tuple[float | None, ...]
"""One value per joint; `None` where there are too few samples."""


@dataclass(frozen=True)
class JointErrors:
    """Root-mean-square errors of one predictor in one unit, one per joint.

    Attributes:
        all: over all samples.
        moving: over the samples in which the joint moves.
        rest: over the samples in which it rests.
        normalised: of `all`, divided by the standard deviation of the measured quantity (nRMSE).
    """

    all: ByJoint
    moving: ByJoint
    rest: ByJoint
    normalised: ByJoint

    @property
    def in_motion(self) -> ByJoint:
        """The error in motion, or over all samples for a joint that does not move in the data."""
        return tuple(a if m is None else m for a, m in zip(self.all, self.moving, strict=True))

    @classmethod
    def of(cls, error: Tensor, measured: Tensor, moving: Tensor) -> JointErrors:
        """From differences, the measured quantity and whether the joint moves, each `(n, nq)`."""
        spread = measured.std(0, correction=0)
        total = _rmse(error, torch.ones_like(moving), fewest=1)
        return cls(
            all=total,
            moving=_rmse(error, moving, FEWEST),
            rest=_rmse(error, ~moving, FEWEST),
            normalised=tuple(
                None if e is None or s == 0.0 else e / s for e, s in zip(total, spread.tolist(), strict=True)
            ),
        )


def _rmse(error: Tensor, rows: Tensor, fewest: int) -> ByJoint:
    pairs = zip(error.unbind(-1), rows.unbind(-1), strict=True)
    return tuple(float((e[r] ** 2).mean().sqrt()) if int(r.sum()) >= fewest else None for e, r in pairs)


def moving_joints(qd: Tensor) -> Tensor:
    """Whether each joint moves, `(n, nq)` bool: |q̇| > max(`REST` · its 95 % quantile, `SLOWEST`).

    Args:
        qd: `(n, nq)` joint velocities [rad/s, m/s].
    """
    fast = qd.abs().quantile(0.95, dim=0) if len(qd) < 1_000_000 else qd.abs().amax(0)
    return qd.abs() > (REST * fast).clamp(min=SLOWEST)
