"""A model never changes: it keeps what the caller passed, and fits twice to the same bits; nor does a fit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

import forcegp
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.models import LearningOptions
from forcegp.models.analytical import Window
from forcegp.models.minibatch import BatchOptions
from forcegp.models.structured_fit import StructuredFit
from forces.cases import draw, logged, mixed_contacts, two_contacts
from random_data import random_data, table_system

SYSTEM = table_system()
DATA = random_data(SYSTEM, 24)
FEW, EPOCHS = LearningOptions(max_evaluations=4), BatchOptions(epochs=3, batch=8)
CASES: dict[type, tuple[dict[str, Any], Any]] = {
    forcegp.StructuredGP: (
        {
            "mean": "analytical",
            "noise": [0.1] * 7,
            "force_priors": [forcegp.priors.JointForcePrior()],
            "inertia": None,
        },
        FEW,
    ),
    forcegp.models.IndependentGP: (
        {"noise": [0.2] * 7, "standardize": False},
        LearningOptions(max_evaluations=2),
    ),
    forcegp.models.NeuralNetwork: ({"hidden": [6, 5], "seed": 4}, EPOCHS),
    forcegp.AnalyticalModel: (
        {"analytical_parameters": {"damping": "all"}, "window": Window(relative=0.2), "seed": 4},
        EPOCHS,
    ),
}
every_model = pytest.mark.parametrize("kind", CASES, ids=lambda kind: kind.__name__)


@every_model
def test_parameters_are_what_the_caller_passed_before_and_after_a_fit(kind: type) -> None:
    given, options = CASES[kind]
    model = kind(SYSTEM, **given)
    state = dict(vars(model))
    for _ in range(2):
        params = model.get_params()
        assert params["system"] is SYSTEM
        assert all(params[name] is value for name, value in given.items())
        model.fit(DATA, options=options)
    assert vars(model).keys() == state.keys()
    assert all(value is state[name] for name, value in vars(model).items())


@every_model
def test_two_fits_have_the_same_bits(kind: type) -> None:
    given, options = CASES[kind]
    model = kind(SYSTEM, **given)
    first = model.fit(DATA, options=options)
    model.fit(DATA[:12], options=options)
    torch.rand(5)
    second = model.fit(DATA, options=options)
    assert first.result.history == second.result.history
    one, two = first.record()[1], second.record()[1]
    assert one.keys() == two.keys()
    assert all(torch.equal(value, two[name]) for name, value in one.items())


@every_model
def test_a_model_says_how_to_get_a_fit(kind: type) -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'predict'; call fit = model\.fit\(data\)"):
        kind(SYSTEM).predict(DATA.q, DATA.qd, DATA.tau)
    with pytest.raises(AttributeError, match=r"no attribute 'colour'$"):
        kind(SYSTEM).colour  # noqa: B018


CHANGES: dict[str, Callable[[StructuredFit], StructuredFit]] = {
    "update": lambda fit: fit.update(logged(two_contacts(), 6, seed=5)),
    "condition": lambda fit: fit.condition(logged(two_contacts(), 6, seed=5)),
    "forget": lambda fit: fit.forget(0.5),
    "forget samples": lambda fit: fit.forget(logged(two_contacts(), 16)[:4]),
}


@pytest.mark.parametrize(
    ("change", "inference"),
    [("update", "exact"), ("condition", "exact"), *((change, "sparse") for change in CHANGES)],
)
def test_a_fit_predicts_the_same_bits_after_others_were_made_of_it(change: str, inference: str) -> None:
    noise = forcegp.Noise(0.1, torque=0.2)
    model = forcegp.StructuredGP(
        two_contacts(), "analytical", [JointFrictionPrior()], noise, inference=inference
    )
    fit = model.fit(logged(two_contacts(), 16), learn=[])

    def predicted(one: StructuredFit) -> list[torch.Tensor]:
        at = [one.predict(*draw(5, seed=3), name, active=mixed_contacts(5)) for name in ("qdd", "multiplier")]
        return [x for part in at for x in (part.mean, part.variance) if x is not None]

    before, record = predicted(fit), {name: x.clone() for name, x in fit.record()[1].items()}
    other = CHANGES[change](fit)
    assert all(torch.equal(a, b) for a, b in zip(predicted(fit), before, strict=True))
    assert all(torch.equal(x, record[name]) for name, x in fit.record()[1].items())
    assert not torch.equal(predicted(other)[1], before[1])
