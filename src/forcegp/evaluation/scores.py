"""Errors of predicted accelerations by joint, coverage and density of their distribution, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist, median

import torch
from torch import Tensor

REST = 0.02
"""Fraction of the 95 % quantile of a joint's speed below which the joint counts as being at rest."""
SLOWEST = 5e-3
"""Speed below which every joint counts as at rest [rad/s, m/s], so that noise is not taken for motion."""
FEWEST = 10
"""Minimum number of samples required to compute an error in motion or at rest."""


@dataclass(frozen=True)
class Errors:
    """Differences between predicted and reference accelerations [rad/s², m/s²].

    Attributes:
        mae: mean absolute error over samples and joints.
        rmse: root-mean-square error over samples and joints.
        mae_by_joint, rmse_by_joint: the same errors for each joint.
    """

    mae: float
    rmse: float
    mae_by_joint: tuple[float, ...]
    rmse_by_joint: tuple[float, ...]

    @classmethod
    def of(cls, error: Tensor) -> Errors:
        """Compute the errors from differences `(n, nq)`."""
        return cls(
            mae=float(error.abs().mean()),
            rmse=float((error**2).mean().sqrt()),
            mae_by_joint=tuple(error.abs().mean(0).tolist()),
            rmse_by_joint=tuple((error**2).mean(0).sqrt().tolist()),
        )


ByJoint = tuple[float | None, ...]
"""One value per joint, or `None` if there are too few samples."""


@dataclass(frozen=True)
class JointErrors:
    """RMS errors of a predictor for each joint, in a single unit.

    Attributes:
        all: error over all samples.
        moving: error over the samples at which the joint moves.
        rest: error over the samples at which the joint is at rest.
        normalised: `all` divided by the standard deviation of the measured quantity.
    """

    all: ByJoint
    moving: ByJoint
    rest: ByJoint
    normalised: ByJoint

    @property
    def in_motion(self) -> ByJoint:
        """Error in motion, or the error over all samples if a joint hardly moves in the data."""
        return tuple(a if m is None else m for a, m in zip(self.all, self.moving, strict=True))

    @classmethod
    def of(cls, error: Tensor, measured: Tensor, moving: Tensor) -> JointErrors:
        """Compute the errors from differences, the measured quantity and a mask of motion, each `(n, nq)`."""
        spread = measured.std(0, correction=0)
        total = _rmse(error, torch.ones_like(moving), fewest=1)
        pairs = zip(total, spread.tolist(), strict=True)
        normalised = tuple(None if e is None or s == 0.0 else e / s for e, s in pairs)
        return cls(total, _rmse(error, moving, FEWEST), _rmse(error, ~moving, FEWEST), normalised)


def _rmse(error: Tensor, rows: Tensor, fewest: int) -> ByJoint:
    pairs = zip(error.unbind(-1), rows.unbind(-1), strict=True)
    return tuple(float((e[r] ** 2).mean().sqrt()) if int(r.sum()) >= fewest else None for e, r in pairs)


def moving_joints(qd: Tensor) -> Tensor:
    """Return a mask `(n, nq)` of moving joints, for which |q̇| > max(`REST` · 95 % quantile, `SLOWEST`)."""
    fast = qd.abs().quantile(0.95, dim=0) if len(qd) < 1_000_000 else qd.abs().amax(0)
    return qd.abs() > (REST * fast).clamp(min=SLOWEST)


LEVELS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
"""Probabilities of the central intervals for which coverage is computed."""


@dataclass(frozen=True)
class Uncertainty:
    """Coverage and density of the predictive distribution of accelerations.

    Attributes:
        coverage_noisy: fraction of measured accelerations within ±2σ, where σ includes the noise.
        coverage_clean: fraction of noise-free accelerations within ±2σ, or `None` if they are not logged.
        coverage_by_joint: `coverage_noisy` for each joint.
        calibration: fraction of measured accelerations in the central interval for each level in `LEVELS`.
        nlpd: mean negative log predictive density of the measured joint accelerations [nats].
    """

    coverage_noisy: float
    coverage_clean: float | None
    coverage_by_joint: tuple[float, ...]
    calibration: dict[str, float]
    nlpd: float

    @classmethod
    def of(
        cls, mean: Tensor, variance: Tensor, noise_std: Tensor, measured: Tensor, clean: Tensor | None
    ) -> Uncertainty:
        """Compute the scores from predictions and accelerations `(n, nq)`, and the noise `(nq,)`."""
        std = (variance + noise_std**2).sqrt()
        deviation = (measured - mean).abs() / std
        half_widths = {f"{level:g}": NormalDist().inv_cdf(0.5 + 0.5 * level) for level in LEVELS}
        within = None if clean is None else share((clean - mean).abs() <= 2.0 * variance.sqrt())
        return cls(
            coverage_noisy=share(deviation <= 2.0),
            coverage_clean=within,
            coverage_by_joint=tuple((deviation <= 2.0).to(mean.dtype).mean(0).tolist()),
            calibration={level: share(deviation <= width) for level, width in half_widths.items()},
            nlpd=nlpd(measured - mean, std),
        )


def nlpd(error: Tensor, std: Tensor) -> float:
    """Return the mean negative log density of errors under a centred normal distribution [nats]."""
    return float((0.5 * (error / std) ** 2 + std.log() + 0.5 * math.log(2.0 * math.pi)).mean())


def share(inside: Tensor) -> float:
    """Return the fraction of true entries."""
    return float(inside.to(torch.float64).mean())


TINY = 1e-12
"""Errors below this value count as equal, since accelerations of order one have rounding errors."""
EQUAL = 1e-9
"""Tolerance within which an error ratio counts as one, to allow for rounding errors."""


@dataclass(frozen=True)
class PredictorScores:
    """Errors of a model or a trivial predictor.

    Attributes:
        name: `model`, `mean`, `robot file` or `least squares`.
        torque: error M(q)(predicted − measured q̈) [N m, N], with the mass matrix M of the robot file.
        acceleration: error in q̈ [rad/s², m/s²].
        nlpd: mean negative log predictive density of the measured joint accelerations [nats]. The standard
            deviation of a trivial predictor is constant and equal to its training error.
        explained: R² of each joint, which is the explained fraction of the non-gravitational torque.
    """

    name: str
    torque: JointErrors
    acceleration: JointErrors
    nlpd: float | None
    explained: ByJoint = ()

    @property
    def beyond_gravity(self) -> float | None:
        """Explained fraction of the non-gravitational torque, as the median over the joints."""
        known = [share for share in self.explained if share is not None]
        return median(known) if known else None


@dataclass(frozen=True)
class Verdict:
    """Comparison of a model with a trivial predictor.

    Attributes:
        against: name of the trivial predictor.
        torque, acceleration: ratio of the model's error to that of the predictor, as the geometric mean over
            the joints for samples in motion. The model is better if the ratio is below 1.
        worse: joints at which the model has the larger torque or acceleration error, or `every joint`.
    """

    against: str
    torque: float
    acceleration: float
    worse: tuple[str, ...]

    @property
    def better(self) -> bool:
        """Whether the model has smaller errors in both torque and acceleration."""
        return max(self.torque, self.acceleration) < 1.0 - EQUAL

    def text(self) -> str:
        """Return the comparison as a sentence."""
        head = f"{'Better' if self.better else 'Not better'} than {_noun(self.against)}: error ratio "
        joints = f"; worse on {_listed(self.worse)}" if self.worse else ""
        return f"{head}{self.torque:.3g} in torque and {self.acceleration:.3g} in acceleration{joints}."


def verdicts(scores: Sequence[PredictorScores], joint_names: Sequence[str]) -> tuple[Verdict, ...]:
    """Compare the first predictor, which is the model, with each of the others."""
    model, *others = scores
    result = []
    for other in others:
        units = "torque", "acceleration"
        ratios = {unit: _ratios(getattr(model, unit), getattr(other, unit)) for unit in units}
        pairs = zip(joint_names, zip(*ratios.values(), strict=True), strict=True)
        worse = [name for name, pair in pairs if max(pair) > 1.0 + EQUAL]
        worse = ["every joint"] if len(worse) == len(joint_names) else worse
        means = {unit: math.exp(sum(map(math.log, r)) / len(r)) for unit, r in ratios.items()}
        result.append(Verdict(other.name, **means, worse=tuple(worse)))
    return tuple(result)


def _ratios(ours: JointErrors, theirs: JointErrors) -> list[float]:
    pairs = zip(ours.in_motion, theirs.in_motion, strict=True)
    return [max(a or 0.0, TINY) / max(b or 0.0, TINY) for a, b in pairs]


def sentence(comparisons: Sequence[Verdict]) -> str:
    """Return the verdict in one sentence, or an empty string if there are no comparisons."""
    better = _listed([_noun(v.against) for v in comparisons if v.better])
    worse = _listed([_noun(v.against) for v in comparisons if not v.better])
    parts = [f"is better than {better}"] if better else []
    parts += [f"is not better than {worse}"] if worse else []
    return f"The model {', but '.join(parts)}." if parts else ""


def _listed(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def _noun(predictor: str) -> str:
    return predictor if predictor == "least squares" else f"the {predictor}"
