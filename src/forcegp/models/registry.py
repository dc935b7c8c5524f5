"""The models by the short names of the command line and the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import UnknownNameError
from forcegp.forces.noise import Noise
from forcegp.forces.observations import NoiseStd
from forcegp.forces.priors.sets import PAPER, contact_priors, default_priors
from forcegp.gp.kernels import Kernel
from forcegp.models.analytical import AnalyticalModel
from forcegp.models.base import Model
from forcegp.models.independent_gp import IndependentGP
from forcegp.models.neural import NeuralNetwork
from forcegp.models.structured_gp import StructuredGP

SGP = StructuredGP.kind
Stated = NoiseStd | Noise | None
"""The noise of a model, `None` for what the log states."""


@dataclass(frozen=True)
class Entry:
    """A named model.

    Attributes:
        kind: of the model, as in saved models.
        description: one line for help texts and the report.
        make: builds it from the system, the noise, the seed and options of its own.
    """

    kind: str
    description: str
    make: Callable[..., Model]


def _analytical(system: ConstrainedSystem, noise: Stated, seed: int, **options: Any) -> Model:
    return AnalyticalModel(system, seed=seed, **options)


def _network(system: ConstrainedSystem, noise: Stated, seed: int, **options: Any) -> Model:
    return NeuralNetwork(system, seed=seed, **options)


def _independent(system: ConstrainedSystem, noise: Stated, seed: int, **options: Any) -> Model:
    return IndependentGP(system, noise=noise, **options)


def _chosen(system: ConstrainedSystem, noise: Stated, seed: int, **options: Any) -> Model:
    options = {"mean": "analytical"} | options
    return StructuredGP(system, noise=noise, **options)


def _structured(mean: str, kernel: Kernel | None = None) -> Callable[..., Model]:
    def make(system: ConstrainedSystem, noise: Stated, seed: int, **options: Any) -> Model:
        options = {"mean": mean} | options
        options.setdefault("force_priors", default_priors(system, options["mean"], kernel))
        return StructuredGP(system, noise=noise, **options)

    return make


def _contact(kernel: Kernel | None = None) -> Callable[..., Model]:
    def make(system: ConstrainedSystem, noise: Stated, seed: int, **options: Any) -> Model:
        options = {"mean": "analytical", "force_priors": contact_priors(system, kernel)} | options
        return StructuredGP(system, noise=noise, **options)

    return make


MODELS: dict[str, Entry] = {
    "analytical": Entry(
        AnalyticalModel.kind, "equations of motion with learned inertia and damping, no friction", _analytical
    ),
    "nn": Entry(NeuralNetwork.kind, "neural network with sigmoid layers on (q, qd, tau)", _network),
    "gp": Entry(
        IndependentGP.kind, "one Gaussian process per joint acceleration on (q, qd, tau)", _independent
    ),
    "sgp-zero": Entry(SGP, "structured GP, all joint forces unknown", _structured("zero")),
    "sgp": Entry(SGP, "structured GP around the analytical forces, priors chosen by the data", _chosen),
    "sgp-mean": Entry(
        SGP, "structured GP around the analytical forces, any joint force", _structured("analytical")
    ),
    "sgp-zero-se": Entry(SGP, "sgp-zero with the paper's kernel alone", _structured("zero", PAPER)),
    "sgp-mean-se": Entry(SGP, "sgp-mean with the paper's kernel alone", _structured("analytical", PAPER)),
    "sgp-contact": Entry(
        SGP, "structured GP with mean and a prior on the contact's friction alone", _contact()
    ),
    "sgp-contact-se": Entry(
        SGP, "the same with any tangential force and the paper's kernel", _contact(PAPER)
    ),
}
"""The models, simplest first."""


def create(
    name: str,
    system: ConstrainedSystem,
    *,
    noise: Stated = None,
    seed: int = 0,
    **options: Any,
) -> Model:
    """A model by its short name.

    Args:
        name: a key of `MODELS`.
        system: robot and contacts.
        noise: of measured accelerations, for models that have one; by default what the log states.
        seed: of random initial values, for models that have any.
        options: further arguments of the model's class.

    Raises:
        UnknownNameError: no such model.
    """
    if name not in MODELS:
        raise UnknownNameError("model", name, MODELS)
    return MODELS[name].make(system, noise, seed, **options)
