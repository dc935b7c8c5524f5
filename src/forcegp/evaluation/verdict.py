"""Whether a model is better than the trivial predictors, in one sentence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from forcegp.evaluation.scores import JointErrors

TINY = 1e-12
"""Errors below this are equal: rounding of accelerations of the order of one."""
EQUAL = 1e-9
"""Error ratios that are this close to one are equal, up to rounding."""


@dataclass(frozen=True)
class PredictorScores:
    """Errors of one predictor, a model or a trivial one.

    Attributes:
        name: `model`, `mean`, `robot file` or `least squares`.
        torque: error M(q)(predicted − measured q̈) [N m, N].
        acceleration: error of q̈ [rad/s², m/s²].
        nlpd: mean negative log predictive density of a measured joint acceleration [nats]; a trivial
            predictor has the constant uncertainty of its training error.
    """

    name: str
    torque: JointErrors
    acceleration: JointErrors
    nlpd: float | None


@dataclass(frozen=True)
class Verdict:
    """The model against one trivial predictor.

    Attributes:
        against: name of the predictor.
        torque, acceleration: the model's error relative to the predictor's, geometric mean over the joints,
            samples in motion; below 1 the model is better.
        worse: joints on which the model's torque or acceleration error is larger, or `every joint`.
    """

    against: str
    torque: float
    acceleration: float
    worse: tuple[str, ...]

    @property
    def better(self) -> bool:
        """Whether the model is better in torque and in acceleration."""
        return max(self.torque, self.acceleration) < 1.0 - EQUAL

    def text(self) -> str:
        """The comparison as one sentence."""
        head = f"{'Better' if self.better else 'Not better'} than {_noun(self.against)}: error ratio "
        joints = f"; worse on {_listed(self.worse)}" if self.worse else ""
        return f"{head}{self.torque:.3g} in torque and {self.acceleration:.3g} in acceleration{joints}."


def verdicts(scores: Sequence[PredictorScores], joint_names: Sequence[str]) -> tuple[Verdict, ...]:
    """The first predictor, the model, against each of the others.

    Args:
        scores: the model's, then those of the trivial predictors.
        joint_names: one per error.
    """
    model, *others = scores
    found = []
    for other in others:
        ratios = {
            unit: _ratios(getattr(model, unit), getattr(other, unit)) for unit in ("torque", "acceleration")
        }
        worse = [
            name for name, pair in zip(joint_names, zip(*ratios.values(), strict=True), strict=True)
            if max(pair) > 1.0 + EQUAL
        ]  # fmt: skip
        worse = ["every joint"] if len(worse) == len(joint_names) else worse
        means = {unit: math.exp(sum(map(math.log, r)) / len(r)) for unit, r in ratios.items()}
        found.append(Verdict(other.name, **means, worse=tuple(worse)))
    return tuple(found)


def _ratios(ours: JointErrors, theirs: JointErrors) -> list[float]:
    pairs = zip(ours.in_motion, theirs.in_motion, strict=True)
    return [max(a or 0.0, TINY) / max(b or 0.0, TINY) for a, b in pairs]


def sentence(found: Sequence[Verdict]) -> str:
    """The verdict in one sentence, or "" where there was nothing to compare with."""
    better = _listed([_noun(v.against) for v in found if v.better])
    worse = _listed([_noun(v.against) for v in found if not v.better])
    parts = [f"is better than {better}"] if better else []
    parts += [f"is not better than {worse}"] if worse else []
    return f"The model {', but '.join(parts)}." if parts else ""


def _listed(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def _noun(predictor: str) -> str:
    return predictor if predictor == "least squares" else f"the {predictor}"
