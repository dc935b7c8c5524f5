"""The models by their short names."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import forcegp
from forcegp.errors import UnknownNameError
from forcegp.models.registry import MODELS, create
from random_data import table_system

ROOT = Path(__file__).resolve().parents[2]
system = table_system()


def test_every_name_makes_its_model() -> None:
    kinds = {name: type(create(name, system)) for name in MODELS}
    assert kinds == {
        "analytical": forcegp.AnalyticalModel,
        "nn": forcegp.models.NeuralNetwork,
        "gp": forcegp.models.IndependentGP,
        "sgp-zero": forcegp.StructuredGP,
        "sgp-mean": forcegp.StructuredGP,
        "sgp-zero-se": forcegp.StructuredGP,
        "sgp-mean-se": forcegp.StructuredGP,
        "sgp-contact": forcegp.StructuredGP,
        "sgp-contact-se": forcegp.StructuredGP,
        "sgp": forcegp.StructuredGP,
    }
    for entry in MODELS.values():
        assert entry.description and "\n" not in entry.description and len(entry.description) < 80


def test_the_structured_models_differ_in_mean_and_priors() -> None:
    zero, mean, contact = (create(f"sgp-{name}", system) for name in ("zero", "mean", "contact"))
    assert isinstance(zero, forcegp.StructuredGP) and isinstance(mean, forcegp.StructuredGP)
    assert isinstance(contact, forcegp.StructuredGP)
    assert zero.mean.terms == () and mean.mean == contact.mean == forcegp.priors.AnalyticalMean()
    assert [prior.name for prior in zero.force_priors] == ["joint", "joint_normal"]
    assert [prior.name for prior in mean.force_priors] == ["joint", "joint_normal", "contact_table"]
    paper = create("sgp-mean-se", system)
    assert isinstance(paper, forcegp.StructuredGP)
    assert [prior.name for prior in paper.force_priors] == ["joint", "joint_normal"]
    assert [prior.name for prior in contact.force_priors] == ["contact_table"]


def test_noise_seed_and_options_arrive() -> None:
    network = create("nn", system, seed=5, hidden=(30, 20))
    assert isinstance(network, forcegp.models.NeuralNetwork)
    assert (network.seed, network.hidden) == (5, (30, 20))
    analytical = create("analytical", system, seed=6, analytical_parameters={"mass": "all"})
    assert isinstance(analytical, forcegp.AnalyticalModel)
    assert analytical.seed == 6 and set(analytical.parameters.joints) == {"mass"}
    for name in ("gp", "sgp-zero", "sgp-mean", "sgp-contact"):
        assert create(name, system, noise=0.3).get_params()["noise"] == 0.3


def test_an_unknown_name_lists_the_models() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown model 'spg-mean'(.|\n)*analytical(.|\n)*'sgp-mean'"):
        create("spg-mean", system)


def test_scripts_name_models_that_exist() -> None:
    named = {}
    for folder in ("benchmarks", "examples", "reproduction", "scenes"):
        for path in (x for kind in ("py", "toml") for x in (ROOT / folder).rglob(f"*.{kind}")):
            for name in re.findall(r'"(sgp(?:-[a-z]+)*)"', path.read_text(encoding="utf-8")):
                named[name] = path
    assert named and {name: path for name, path in named.items() if name not in MODELS} == {}
