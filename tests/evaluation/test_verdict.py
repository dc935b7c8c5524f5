"""Errors by condition and verdicts, on numbers chosen by hand."""

from __future__ import annotations

import math

import pytest
import torch

from forcegp.evaluation.scores import SLOWEST, JointErrors, PredictorScores, moving_joints, sentence, verdicts


def errors(*by_joint: float) -> JointErrors:
    """The same errors in all conditions."""
    return JointErrors(by_joint, by_joint, by_joint, by_joint)


def scores(name: str, torque: tuple[float, ...], acceleration: tuple[float, ...]) -> PredictorScores:
    return PredictorScores(name, errors(*torque), errors(*acceleration), None)


def test_ratios_are_geometric_means_over_the_joints() -> None:
    model = scores("model", (1.0, 4.0), (1.0, 1.0))
    (found,) = verdicts([model, scores("mean", (2.0, 4.0), (4.0, 4.0))], ("a", "b"))
    assert found.torque == pytest.approx(math.sqrt(0.5)) and found.acceleration == pytest.approx(0.25)
    assert (
        found.better
        and found.worse == ()
        and found.text() == ("Better than the mean: error ratio 0.707 in torque and 0.25 in acceleration.")
    )


def test_a_model_must_be_better_in_both_units() -> None:
    model = scores("model", (1.0, 1.0), (3.0, 1.0))
    (found,) = verdicts([model, scores("least squares", (2.0, 2.0), (1.0, 1.0))], ("a", "b"))
    assert not found.better and found.worse == ("a",)
    assert found.text().startswith("Not better than least squares: error ratio 0.5 in torque ")
    assert found.text().endswith("; worse on a.")


def test_equal_predictors_are_not_better_and_exact_ones_do_not_divide_by_zero() -> None:
    same = scores("model", (0.0, 1.0), (0.0, 1.0))
    (found,) = verdicts([same, same], ("a", "b"))
    assert found.torque == 1.0 and not found.better and found.worse == ()
    worse = scores("model", (2.0, 2.0), (2.0, 2.0))
    assert verdicts([worse, same], ("a", "b"))[0].worse == ("every joint",)


def test_the_sentence_names_each_predictor_once() -> None:
    model = scores("model", (1.0,), (1.0,))
    others = [
        scores(name, (e,), (e,)) for name, e in (("mean", 2.0), ("robot file", 3.0), ("least squares", 0.5))
    ]
    found = verdicts([model, *others], ("a",))
    expected = "The model is better than the mean and the robot file, but is not better than least squares."
    assert sentence(found) == expected
    assert sentence(found[:2]) == "The model is better than the mean and the robot file."
    assert sentence(()) == ""


def test_errors_in_motion_and_at_rest_are_apart() -> None:
    qd = torch.zeros(40, 2, dtype=torch.float64)
    qd[:20, 0] = 1.0
    moving = moving_joints(qd)
    assert moving[:, 0].tolist() == [True] * 20 + [False] * 20 and not moving[:, 1].any()
    error = torch.where(moving, 3.0, 4.0)
    measured = torch.arange(80, dtype=torch.float64).reshape(40, 2)
    found = JointErrors.of(error.double(), measured, moving)
    assert found.moving == (3.0, None) and found.rest == (4.0, 4.0)
    # A joint that never moves is judged over all samples.
    assert found.in_motion == (3.0, 4.0)
    assert found.all[0] == pytest.approx(math.sqrt(12.5))
    std = math.sqrt((1600 - 1) / 12) * 2
    assert found.normalised[1] == pytest.approx(4.0 / std)


def test_noise_of_a_resting_joint_is_not_motion() -> None:
    qd = 0.5 * SLOWEST * torch.randn(100, 1, generator=torch.Generator().manual_seed(0)).clamp(-1, 1)
    assert not moving_joints(qd).any()
