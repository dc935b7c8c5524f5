"""Options of models: refusal of wrong values, agreement of the constructor with the table `[model]`."""

from __future__ import annotations

import inspect
from typing import Any

import pytest

import forcegp
from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.priors.joint import AnalyticalMean
from forcegp.models import Inference
from forcegp.models.independent_gp import IndependentGP
from forcegp.models.structured_gp import StructuredGP
from forcegp.scene.sections import ModelSection
from random_data import table_system

SYSTEM = table_system()


def test_the_table_has_the_defaults_of_the_constructors() -> None:
    arguments = inspect.signature(StructuredGP).parameters
    section = ModelSection()
    assert section.inference == Inference(arguments["inference"].default)
    assert section.inertia == arguments["inertia"].default
    assert section.standardize == inspect.signature(IndependentGP).parameters["standardize"].default


@pytest.mark.parametrize(
    ("made", "options", "kind", "match"),
    [
        (StructuredGP, {"inference": "sparce"}, UnknownNameError, r"inference 'sparce'[\s\S]*'sparse'"),
        (StructuredGP, {"inertia": "fle"}, UnknownNameError, r"unknown inertia 'fle'[\s\S]*'file'"),
        (IndependentGP, {"standardize": "no"}, ModelError, r"invalid `standardize`[\s\S]*got: no"),
    ],
)
def test_a_wrong_option_is_refused_by_name(
    made: type, options: dict[str, Any], kind: type, match: str
) -> None:
    with pytest.raises(kind, match=match):
        made(SYSTEM, **options)


@pytest.mark.parametrize("points", [0, True, 2.5])
def test_a_wrong_number_of_points_is_refused(points: Any) -> None:
    with pytest.raises(ModelError, match=r"invalid `inducing_points`[\s\S]*greater than 0"):
        Inference("sparse", inducing_points=points)


def test_options_are_kept_for_the_fit() -> None:
    inference = Inference("sparse", inducing_points=7)
    assert StructuredGP(SYSTEM, "zero", inference=inference).specification.inference is inference


def test_inputs_in_their_units_are_also_those_along_the_normal() -> None:
    """The normal force shares the hyperparameters of the joint force, so also the units of its inputs."""
    joint = forcegp.priors.JointForcePrior(scaled=False)
    assert forcegp.priors.NormalForcePrior(joint).scaled is False
    assert forcegp.priors.NormalForcePrior(forcegp.priors.JointForcePrior()).scaled is True


def test_the_mean_is_analytical_unless_another_is_named() -> None:
    assert StructuredGP(SYSTEM).mean.terms == AnalyticalMean().terms
    assert StructuredGP(SYSTEM, "zero").mean.terms == ()
