"""Models by their short names, which are used on the command line and in reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import signature
from typing import Any

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import check_name
from forcegp.forces.measurements import NoiseStd
from forcegp.forces.noise import Noise
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.sets import PAPER, contact_priors, default_priors
from forcegp.gp.kernels import Kernel
from forcegp.models.analytical import AnalyticalModel
from forcegp.models.base import Model
from forcegp.models.independent_gp import IndependentGP
from forcegp.models.neural import NeuralNetwork
from forcegp.models.structured_gp import StructuredGP


@dataclass(frozen=True)
class Entry:
    """A named model.

    Attributes:
        made: the class of the model.
        description: one-line description for help texts and the report.
        options: arguments of the class.
        priors: a function that returns the force priors for a system, mean and kernel, or `None` if the class
            selects the priors.
        kernel: the kernel of these priors. `None` selects the default kernel.
    """

    made: type[Any]
    description: str
    options: Mapping[str, Any] = field(default_factory=dict)
    priors: Callable[[ConstrainedSystem, Any, Kernel | None], Sequence[ForcePrior]] | None = None
    kernel: Kernel | None = None


def _contact(system: ConstrainedSystem, mean: Any, kernel: Kernel | None) -> Sequence[ForcePrior]:
    """Return priors on contact friction only, whatever the mean."""
    return contact_priors(system, kernel)


ZERO, ANALYTICAL = {"mean": "zero"}, {"mean": "analytical"}
MODELS: dict[str, Entry] = {
    "analytical": Entry(AnalyticalModel, "equations of motion with learned inertia and damping, no friction"),
    "nn": Entry(NeuralNetwork, "neural network with sigmoid layers on (q, qd, tau)"),
    "gp": Entry(IndependentGP, "one Gaussian process per joint acceleration on (q, qd, tau)"),
    "sgp-zero": Entry(StructuredGP, "structured GP, all joint forces unknown", ZERO, default_priors),
    "sgp": Entry(
        StructuredGP, "structured GP with analytical mean, priors selected using the data", ANALYTICAL
    ),
    "sgp-mean": Entry(
        StructuredGP,
        "structured GP with analytical mean, any joint force unknown",
        ANALYTICAL,
        default_priors,
    ),
    "sgp-zero-se": Entry(StructuredGP, "sgp-zero with only the paper's kernel", ZERO, default_priors, PAPER),
    "sgp-mean-se": Entry(
        StructuredGP, "sgp-mean with only the paper's kernel", ANALYTICAL, default_priors, PAPER
    ),
    "sgp-contact": Entry(
        StructuredGP,
        "structured GP with analytical mean, only contact friction unknown",
        ANALYTICAL,
        _contact,
    ),
    "sgp-contact-se": Entry(
        StructuredGP, "the same with any tangential force and the paper's kernel", ANALYTICAL, _contact, PAPER
    ),
}
"""Models by name, from simplest to most complex."""


def create(
    name: str,
    system: ConstrainedSystem,
    *,
    noise: NoiseStd | Noise | None = None,
    seed: int = 0,
    **options: Any,
) -> Model:
    """Create a model from its short name.

    Args:
        name: a key of `MODELS`.
        system: the robot and its contacts.
        noise: noise of measured accelerations, if the model uses it. The default is the value in the log.
        seed: random seed for initial values, if the model uses them.
        options: other arguments of the model class.

    Raises:
        UnknownNameError: the model does not exist.
    """
    check_name("model", name, MODELS)
    entry = MODELS[name]
    taken = signature(entry.made).parameters
    arguments: dict[str, Any] = {key: x for key, x in (("noise", noise), ("seed", seed)) if key in taken}
    arguments |= {**entry.options, **options}
    if entry.priors is not None and "force_priors" not in options:
        arguments["force_priors"] = entry.priors(system, arguments["mean"], entry.kernel)
    return entry.made(system, **arguments)
