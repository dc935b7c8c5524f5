"""One table of options: the constructor, the table `[model]` of scenes and saved files agree with it."""

from __future__ import annotations

import inspect
from typing import Any

import pytest

from forcegp.errors import ModelError, UnknownNameError
from forcegp.forces.priors.joint import AnalyticalMean
from forcegp.models.independent_gp import IndependentGP, IndependentSettings
from forcegp.models.structured_file import StructuredSettings
from forcegp.models.structured_gp import StructuredGP
from forcegp.options import KernelOptions, StructuredOptions
from forcegp.scene.sections import ModelSection
from random_data import table_system

SYSTEM = table_system()


@pytest.mark.parametrize(
    ("made", "table", "saved"),
    [
        (StructuredGP, StructuredOptions, StructuredSettings),
        (IndependentGP, KernelOptions, IndependentSettings),
    ],
)
def test_every_place_has_the_options_with_their_defaults(
    made: type, table: type[KernelOptions], saved: type[KernelOptions]
) -> None:
    arguments = inspect.signature(made).parameters
    for name, field in table.model_fields.items():
        assert arguments[name].default == field.default
        for other in (saved, ModelSection):
            own = other.model_fields[name]
            assert (own.default, own.annotation) == (field.default, field.annotation)


@pytest.mark.parametrize(
    ("options", "kind", "match"),
    [
        ({"inference": "sparce"}, UnknownNameError, r"unknown inference 'sparce'[\s\S]*'sparse'"),
        ({"inertia": "fle"}, UnknownNameError, r"unknown inertia 'fle'[\s\S]*'file'"),
        ({"inducing_points": 0}, ModelError, r"invalid `inducing_points`[\s\S]*greater than 0"),
        ({"inducing_points": True}, ModelError, r"invalid `inducing_points`[\s\S]*integer"),
        ({"standardize": "no"}, ModelError, r"invalid `standardize`[\s\S]*boolean"),
    ],
)
def test_a_wrong_option_is_refused_by_name(options: dict[str, Any], kind: type, match: str) -> None:
    with pytest.raises(kind, match=match):
        StructuredOptions.of(options)


def test_options_are_kept_for_the_fit() -> None:
    spec = StructuredGP(
        SYSTEM, "zero", inference="sparse", inducing_points=7, standardize=False
    ).specification
    assert spec.options == StructuredOptions(inference="sparse", inducing_points=7, standardize=False)


def test_the_mean_is_analytical_unless_another_is_named() -> None:
    assert StructuredGP(SYSTEM).mean.terms == AnalyticalMean().terms
    assert StructuredGP(SYSTEM, "zero").mean.terms == ()
