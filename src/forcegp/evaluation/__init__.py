"""Quality of a model: errors and uncertainty by joint, comparison with trivial predictors, and a verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.data.selection import outliers
from forcegp.errors import DataError, NumericalError
from forcegp.evaluation.judgement import (
    Motion,
    PayloadChange,
    beyond_gravity,
    explained,
    open_loop,
    payload_change,
    torque_response,
)
from forcegp.evaluation.least_squares import FEWEST_TRAINING, as_torque, baselines, without_constraint
from forcegp.evaluation.predicted import (
    MultiplierScore,
    Predicted,
    Progress,
    multiplier_scores,
    predict_all,
    sensed_scores,
)
from forcegp.evaluation.scores import (
    FEWEST,
    Errors,
    JointErrors,
    PredictorScores,
    Uncertainty,
    Verdict,
    moving_joints,
    nlpd,
    sentence,
    verdicts,
)
from forcegp.files import finite
from forcegp.models.base import FittedModel, Predictor
from forcegp.rows import describe, numbered

__all__ = ["Evaluation", "evaluate"]

GRAVITY_ALONE, LEAST_RESPONSE = 0.99, 0.5
"""Fraction of torque due to gravity above which data are a weak test; minimum response to an added torque."""
FAR_WORSE, SUPPORTED = 2.0, 0.7
"""Acceleration errors relative to the error of the mean: above `FAR_WORSE`, a joint is far worse than the
mean; below `SUPPORTED`, the log supports an inertia that differs from that of the robot file."""


@dataclass(frozen=True)
class Evaluation:
    """Scores of a model's predictions on a data set.

    Attributes:
        kind: type of the model.
        samples: number of predictions.
        joint_names: names of the joints, in the order of the per-joint scores.
        noisy: errors relative to the measured accelerations.
        clean: errors relative to the noise-free accelerations, or `None` if they are not logged.
        uncertainty: coverage and density, or `None` if there is no covariance or the noise is unknown.
        residual, residual_max: mean and largest |A q̈ − b| of the predicted mean over closed contacts [m/s²],
            or `None` if no contact is closed.
        noise_std: assumed standard deviation of the acceleration noise, one per joint.
        seconds_per_state: prediction time per state, including the covariance if there is one.
        predictors: per-joint errors of the model and of the trivial predictors.
        verdicts: comparison of the model with each trivial predictor, empty if there are too few samples.
        multipliers: comparison of λ with logged values if the model predicts forces and the log contains λ.
        sensed: the same comparison for predictions that use the force sensor, if the fit included the sensor.
        gravity: fraction R² of the torque that gravity alone explains. If near 1, the log is a weak test.
        response: effect of an added torque at each joint, M(q) Δq̈ relative to the torque, with M of the robot
            file. It is 1 if the model has the inertia of the file, and `None` if there is no free motion.
        own_response: the same with the mass matrix of the model. It is 1 for a rigid robot, and 0 for a model
            that has learned the controller.
        motion: open-loop motion if the model predicts forces and the data are in time order.
        payload: change of the payload since the training, if one is found in free motion.
        left_out: rows of the data that are not evaluated, since a value in them is impossible.
    """

    kind: str
    samples: int
    joint_names: tuple[str, ...]
    noisy: Errors
    clean: Errors | None
    uncertainty: Uncertainty | None
    residual: float | None
    residual_max: float | None
    noise_std: tuple[float, ...] | None
    seconds_per_state: float
    predictors: tuple[PredictorScores, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    multipliers: tuple[MultiplierScore, ...] = ()
    sensed: tuple[MultiplierScore, ...] = ()
    gravity: float | None = None
    response: tuple[float, ...] | None = None
    own_response: tuple[float, ...] | None = None
    motion: Motion | None = None
    payload: PayloadChange | None = None
    left_out: tuple[int, ...] = ()

    @property
    def verdict(self) -> str:
        """One-sentence verdict on non-gravitational torque, open-loop motion and contact forces."""
        parts, shares = [], {p.name: p.beyond_gravity for p in self.predictors}
        if (share := shares.pop("model", None)) is not None:
            others = [f"{n} {_percent(x)}" for n, x in shares.items() if x is not None and n != "mean"]
            parts.append(
                f"the model explains {_percent(share)} of the non-gravitational torque ({', '.join(others)})"
            )
        if self.motion is not None:
            at = min(1, len(self.motion.horizons) - 1)
            off, file = (
                "more than its motion" if x is None or x > 1.0 else f"{_percent(x)} of its motion"
                for x in (self.motion.model[at], self.motion.robot_file[at])
            )
            after = f"{self.motion.horizons[at]:g} s in open loop"
            parts.append(
                f"after {after} the arm is off by {off} (robot file {file.removesuffix(' of its motion')})"
            )
        parts += [score.text() for score in self.multipliers]
        text = "; ".join(parts)
        return f"{text[:1].upper()}{text[1:]}." if parts else ""

    @property
    def poor(self) -> bool:
        """Whether there are `doubts`, or the model explains no torque or less than the robot file does."""
        shares = {p.name: x for p in self.predictors if (x := p.beyond_gravity) is not None}
        model = shares.get("model", 1.0)
        return bool(self.doubts) or model <= 0.0 or model < shares.get("robot file", 0.0)

    @property
    def comparison(self) -> str:
        """Sentence on whether the model beats the trivial predictors in both torque and acceleration."""
        return sentence(self.verdicts)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Reasons why the scores may be misleading."""
        sentences = []
        if self.gravity is not None and self.gravity > GRAVITY_ALONE:
            share = f"{100.0 * self.gravity:.1f} %"
            sentences.append(
                f"Gravity alone explains {share} of the torque, so the data hardly test anything else."
            )
        if far := self._beyond_mean(FAR_WORSE):
            units = "rad/s², or m/s² for sliding joints"
            text = ", ".join(
                f"{joint} {model:.3g} (mean: {mean:.3g})" for joint, (model, mean) in far.items()
            )
            sentences.append(f"Acceleration errors are far larger than those of the mean [{units}]: {text}.")
        if weak := self._responding(self.own_response, LEAST_RESPONSE, math.inf):
            text = f"An added torque has too small an effect (expected: 1): {_values(weak)}."
            sentences.append(f"{text} The model has learned the controller, not the arm.")
        if self.payload is not None:
            mass, std = self.payload.mass, self.payload.std
            size = f"{abs(mass):.3g} ± {2.0 * std:.1g} kg {'more' if mass > 0.0 else 'less'}"
            sentences.append(
                f"Free motion fits with {size} on the last link than the model has: the payload changed, "
                "or the model has wrong masses. Contact forces include this weight."
            )
        if self.left_out:
            rows = describe(numbered(np.array(self.left_out))).capitalize()
            sentences.append(f"{rows}: left out, since a value is impossible.")
        changed = self._responding(self.response, LEAST_RESPONSE, 1.0 / LEAST_RESPONSE)
        doubtful = changed.keys() & self._beyond_mean(SUPPORTED).keys() - weak.keys()
        if other := {joint: x for joint, x in changed.items() if joint in doubtful}:
            text = (
                f"An added torque has another effect than in the robot file (expected: 1): {_values(other)}."
            )
            sentences.append(f"{text} The logged accelerations of these joints do not support the inertia.")
        return tuple(sentences)

    def _beyond_mean(self, factor: float) -> dict[str, tuple[float, float]]:
        """Return the errors of the model and of the mean in q̈, for joints with a ratio above `factor`."""
        errors = {p.name: p.acceleration.in_motion for p in self.predictors}
        if "mean" not in errors:
            return {}
        pairs = zip(self.joint_names, errors["model"], errors["mean"], strict=True)
        known = {joint: (x, mean) for joint, x, mean in pairs if x is not None and mean is not None}
        return {joint: (x, mean) for joint, (x, mean) in known.items() if x > factor * mean}

    def _responding(self, response: tuple[float, ...] | None, low: float, high: float) -> dict[str, float]:
        """Return the joints with a response to an added torque outside an interval."""
        pairs = () if response is None else zip(self.joint_names, response, strict=True)
        return {joint: x for joint, x in pairs if not low <= x <= high}

    def to_dict(self) -> dict[str, Any]:
        """Return all scores as JSON-compatible values."""
        texts = [verdict.text() for verdict in self.verdicts]
        said = {"verdict": self.verdict, "comparison": self.comparison, "doubts": self.doubts}
        return finite(asdict(self) | said | {"verdict_texts": texts})

    def summary(self) -> dict[str, float | int | str | None]:
        """Return the overall scores, keyed by name."""
        clean, spread = self.clean, self.uncertainty
        return {
            "kind": self.kind,
            "samples": self.samples,
            "noisy_mae": self.noisy.mae,
            "noisy_rmse": self.noisy.rmse,
            "clean_mae": None if clean is None else clean.mae,
            "clean_rmse": None if clean is None else clean.rmse,
            "coverage_noisy": None if spread is None else spread.coverage_noisy,
            "coverage_clean": None if spread is None else spread.coverage_clean,
            "nlpd": None if spread is None else spread.nlpd,
            "residual": self.residual,
            "residual_max": self.residual_max,
            "seconds_per_state": self.seconds_per_state,
        }


def evaluate(
    model: Predictor,
    data: Dataset,
    *,
    train: Dataset | None = None,
    compare: bool = True,
    system: ConstrainedSystem | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Compare predicted accelerations with those in a data set and with trivial predictors.

    Args:
        model: a fitted model.
        data: states and measured accelerations, and noise-free accelerations as `qdd_clean` if known.
        train: data for fitting the trivial predictors. By default, they are fitted to one half of `data` (in
            row order) to predict the other half, and vice versa.
        compare: whether to fit the trivial predictors.
        system: the robot and contacts for the constraint residual, the torque errors and the trivial
            predictors. The default is the system of the model before learning.
        progress: a function called with the number of states predicted so far and the total number.

    Rows with impossible values are left out, and named in `left_out`. Fewer than ten rows are compared
    with no trivial predictor.

    Raises:
        ForceGPError: the data are empty, their joints differ from those of the robot, or they lack a contact.
        NumericalError: the data are too extreme for least squares.
    """
    if len(data) == 0:
        raise DataError("there is nothing to evaluate on", expected="at least one sample", got="none")
    data.check_robot(model.specified.robot)
    impossible = outliers(data.q, data.qd, data.qdd, data.tau)
    if bool(impossible.any()):
        scored = evaluate(
            model, data[~impossible], train=train, compare=compare, system=system, progress=progress
        )
        return replace(scored, left_out=tuple(impossible.nonzero()[:, 0].tolist()))
    try:
        return _evaluated(model, data, train, compare, system, progress)
    except torch.linalg.LinAlgError as cause:  # pyright: ignore[reportPrivateImportUsage]
        text, hint = "a linear system of the evaluation is singular", "look for outliers with forcegp check"
        raise NumericalError(text, got=str(cause)[:200], hint=hint) from cause


def _evaluated(
    model: Predictor,
    data: Dataset,
    train: Dataset | None,
    compare: bool,
    system: ConstrainedSystem | None,
    progress: Progress | None,
) -> Evaluation:
    """Return the scores on data without outliers."""
    compare = compare and len(data) >= FEWEST
    model.system.announce_states(len(data), 2.0, f"an evaluation on {len(data):,} samples")
    before = system or model.specified
    predicted = predict_all(model, data, system or model.system, progress)
    clean, noise_std = data.extras.get("qdd_clean"), predicted.noise_std
    spread = None
    if predicted.variance is not None and noise_std is not None:
        spread = Uncertainty.of(predicted.mean, predicted.variance, noise_std, data.qdd, clean)
    residual = predicted.residual
    acting = replace(data, tau=model.system.robot.true_torque(data.tau))
    if train is not None:
        train = replace(train, tau=model.system.robot.true_torque(train.tau))
    rest, gravity = beyond_gravity(before, acting) if compare else (None, None)
    scores = () if rest is None else _predictors(model, predicted, spread, before, acting, train, rest)
    real = model if compare and isinstance(model, FittedModel) else None
    return Evaluation(
        kind=model.kind,
        samples=len(data),
        joint_names=data.joint_names,
        noisy=Errors.of(predicted.mean - data.qdd),
        clean=None if clean is None else Errors.of(predicted.mean - clean),
        uncertainty=spread,
        residual=float(residual.mean()) if len(residual) else None,
        residual_max=float(residual.max()) if len(residual) else None,
        noise_std=None if noise_std is None else tuple(noise_std.square().mean(0).sqrt().tolist()),
        seconds_per_state=predicted.seconds / len(data),
        predictors=scores,
        verdicts=verdicts(scores, data.joint_names) if scores else (),
        multipliers=multiplier_scores(model, data) if model.force_field() else (),
        sensed=sensed_scores(model, data),
        gravity=gravity,
        response=None if real is None else torque_response(real, before.robot, data),
        own_response=None if real is None else torque_response(real, real.system.robot, data),
        motion=None if real is None else open_loop(real, before, data),
        payload=None if real is None else payload_change(real, predicted.mean - data.qdd, data),
    )


def _values(by_joint: Mapping[str, float]) -> str:
    return ", ".join(f"{joint} {x:.2g}" for joint, x in by_joint.items())


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %" if share >= 0.0 else "nothing"


def _predictors(
    model: Predictor,
    predicted: Predicted,
    spread: Uncertainty | None,
    system: ConstrainedSystem,
    data: Dataset,
    train: Dataset | None,
    rest: Tensor,
) -> tuple[PredictorScores, ...]:
    """Return the per-joint torque and acceleration errors of the model and of the trivial predictors."""
    moving = moving_joints(data.qd)

    def score(name: str, error: Tensor, torque: Tensor, density: float | None) -> PredictorScores:
        by_joint = JointErrors.of(torque, data.tau, moving), JointErrors.of(error, data.qdd, moving)
        of_forces = name != "mean" and (name != "model" or model.force_field() is not None)
        shares = explained(without_constraint(system, data, torque), rest) if of_forces else ()
        return PredictorScores(name, *by_joint, density, shares)

    error = predicted.mean - data.qdd
    torque = as_torque(system, data.q, error)
    scores = [score("model", error, torque, None if spread is None else spread.nlpd)]
    for name, (error, torque, std) in _trivial(system, data, train).items():
        certain = bool((std == 0.0).any())
        scores.append(score(name, error, torque, None if certain else nlpd(error, std)))
    return tuple(scores)


def _trivial(
    system: ConstrainedSystem, data: Dataset, train: Dataset | None
) -> dict[str, tuple[Tensor, Tensor, Tensor]]:
    """Return errors, torque errors and standard deviations `(n, nq)` on data not used for training."""
    train = None if train is None else train[~outliers(train.q, train.qd, train.qdd, train.tau)]
    half = len(data) // 2
    parts = [(train, data)] if train is not None else [(data[half:], data[:half]), (data[:half], data[half:])]
    errors: dict[str, list[tuple[Tensor, Tensor, Tensor]]] = {}
    for training, new in parts:
        if len(training) < FEWEST_TRAINING:
            return {}
        for baseline in baselines(system, training):
            error = baseline.predict(new) - new.qdd
            torque = as_torque(system, new.q, error)
            errors.setdefault(baseline.name, []).append((error, torque, baseline.std.expand_as(error)))
    return {name: tuple(map(torch.cat, zip(*rows, strict=True))) for name, rows in errors.items()}  # pyright: ignore[reportReturnType]
