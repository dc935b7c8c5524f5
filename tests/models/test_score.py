"""`score` and `get_params`, as in scikit-learn."""

from __future__ import annotations

import inspect
from pathlib import Path

import numpy as np
import pytest
import torch

import forcegp
from forcegp.errors import DataError, UnknownNameError
from forcegp.models.base import Model
from forcegp.models.structured_fit import StructuredFit
from forces.cases import logged, two_contacts


def models() -> list[Model]:
    system = two_contacts()
    return [
        forcegp.StructuredGP(system, "analytical", noise=0.2, inference="exact"),
        forcegp.StructuredGP(
            system,
            "zero",
            [forcegp.priors.JointForcePrior()],
            noise=forcegp.Noise(learn=True, torque=0.1),
        ),
        forcegp.models.IndependentGP(system, noise=0.3),
        forcegp.models.NeuralNetwork(system, hidden=(5, 4), seed=3),
        forcegp.AnalyticalModel(system, seed=2),
    ]


@pytest.mark.parametrize("model", models(), ids=lambda model: model.kind)
def test_parameters_make_a_copy(model: Model) -> None:
    given = model.get_params()
    assert given.keys() == inspect.signature(type(model)).parameters.keys()
    copy = type(model)(**given)
    again = copy.get_params()
    assert given.keys() == again.keys()
    for name, value in given.items():
        assert again[name] is value or again[name] == value, name


def test_score_is_the_coefficient_of_determination() -> None:
    model = forcegp.StructuredGP(two_contacts(), "analytical", noise=0.1).fit(
        logged(two_contacts(), 12), learn=[]
    )
    data = logged(two_contacts(), 30, seed=5)
    with torch.no_grad():
        mean = model.predict(data.q, data.qd, data.tau, active=data.active(("table", "ball"))).mean.numpy()
    true = data.qdd.numpy()
    # The formula of scikit-learn's r2_score with multioutput="uniform_average".
    expected = np.mean(1.0 - ((true - mean) ** 2).sum(0) / ((true - true.mean(0)) ** 2).sum(0))
    assert model.score(data) == pytest.approx(expected, rel=1e-12)
    assert model.score(data, "multiplier") < 1.0
    with pytest.raises(UnknownNameError, match="qdd"):
        model.score(data, "qdd_free")
    with pytest.raises(DataError, match="two samples"):
        model.score(data[:1])


@pytest.mark.parametrize("inertia", ["file", "auto"])
def test_a_saved_model_knows_where_its_inertia_is_from(inertia: str, tmp_path: Path) -> None:
    model = forcegp.StructuredGP(two_contacts(), "zero", noise=0.1, inertia=inertia)
    model.fit(logged(two_contacts(), 12), learn=[]).save(tmp_path / "model")
    loaded = forcegp.load_model(tmp_path / "model")
    assert isinstance(loaded, StructuredFit) and loaded.specification.inertia == inertia
