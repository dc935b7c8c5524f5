"""Models defined by the table `[model]` in a scene or in a separate file (see docs/formats.md)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from inspect import signature
from typing import Any

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import SceneError, UnknownNameError, near_names
from forcegp.forces.measurements import NoiseStd
from forcegp.forces.noise import Noise
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.joint import AnalyticalMean
from forcegp.gp.optimise import LearningOptions
from forcegp.learning.specification import WITH_PARAMETERS
from forcegp.models.analytical import ADAM, AnalyticalModel
from forcegp.models.base import FitProgress, FittedModel, Model
from forcegp.models.minibatch import BatchOptions
from forcegp.models.neural import DEEP, SHALLOW, NeuralNetwork
from forcegp.models.registry import MODELS, create
from forcegp.models.sensed import with_sensor
from forcegp.models.structured_file import classes
from forcegp.models.structured_gp import StructuredGP
from forcegp.robot.parameters import AnalyticalParameters
from forcegp.scene import ModelTable
from forcegp.scene.sections import NoiseSection
from forcegp.storage.descriptions import decode

DEFAULT = "sgp"
"""Name of the default model."""
COMMON = ("name", "noise", "seed", "learning")
"""Keys of `[model]` that are accepted for every model, even if the model ignores them."""
ARGUMENTS = {"priors": "force_priors"}
"""Keys that differ from the name of the argument of the model class."""
Options = LearningOptions | BatchOptions


@dataclass(frozen=True, eq=False)
class Configured:
    """A model with its learning options.

    Attributes:
        name: name of the model.
        model: the model.
        options: learning options. `None` selects the default options.
        sensor_noise_std: standard deviation of the force sensor noise [N], if the sensor is used.
    """

    name: str
    model: Model[Any]
    options: Options | None
    sensor_noise_std: float | None = None

    def fit(self, data: Dataset, *, progress: FitProgress | None = None, **settings: Any) -> FittedModel:
        """Fit the model with its options, and use the force sensor if `sensor_noise_std` is given."""
        if self.options is not None:
            settings["options"] = self.options
        if self.sensor_noise_std is not None and isinstance(self.model, StructuredGP):
            both = with_sensor(data, self.model.system, self.sensor_noise_std)
            return self.model.fit(both, progress=progress, **settings)
        return self.model.fit(data, progress=progress, **settings)


def configured(
    table: ModelTable,
    system: ConstrainedSystem,
    *,
    name: str | None = None,
    noise_std: NoiseStd | None = None,
    seed: int | None = None,
) -> Configured:
    """Create the model defined by a table `[model]`.

    Args:
        table: the table from a scene or from `load_model_table`.
        system: the robot and its contacts.
        name, noise_std, seed: values that override the values in the table.

    Raises:
        SceneError: a value is invalid for the model or the system. The message gives the file, line and key.
        UnknownNameError: `name` is not a model.

    Example:
        >>> from forcegp.scene import load_scene
        >>> scene = load_scene("kuka_plane")
        >>> configured(scene.model, scene.system(), name="gp").model.kind
        'independent_gp'
    """
    section, at = table.section, table.document.at
    chosen = name or section.name or DEFAULT
    noise = at(("model", "noise"), _noise, section.noise, noise_std)
    start = section.seed if seed is None else seed
    if chosen not in MODELS:
        unknown = UnknownNameError("model", chosen, MODELS)
        raise unknown if name else SceneError.at(table.document.place(("model", "name")), unknown)
    arguments = _arguments(table, system, chosen)
    model = at(("model",), create, chosen, system, noise=noise, seed=start or 0, **arguments)
    return Configured(chosen, model, _learning(table, model), section.sensor_noise_std)


def keys_of(kind: type[Model[Any]]) -> tuple[str, ...]:
    """Return the keys of `[model]` for a model class: the common keys and the constructor arguments."""
    keys = {argument: key for key, argument in ARGUMENTS.items()}
    arguments = [
        keys.get(name, name) for name in signature(kind).parameters if name not in ("system", *COMMON)
    ]
    return (*COMMON, *arguments, *(("sensor_noise_std",) if kind is StructuredGP else ()))


def _arguments(table: ModelTable, system: ConstrainedSystem, name: str) -> dict[str, Any]:
    """Return the arguments for the model class that are defined in the table."""
    made, at = MODELS[name].made, table.document.at
    entries, arguments = table.section.given(), dict[str, Any]()
    for key, value in entries.items():
        _check_key(table, ("model", key), keys_of(made), f"the model {name!r}")
        if key == "mean" and not isinstance(value, str):
            value = at(("model", "mean"), AnalyticalMean, value)
        elif key == "priors":
            value = _priors(table, table.section.priors)
        elif key == "analytical_parameters":
            theta = at(("model", key), AnalyticalParameters, system.robot, value)
            value = theta if made is StructuredGP else value
        if key not in (*COMMON, "sensor_noise_std"):
            arguments[ARGUMENTS.get(key, key)] = value
    return arguments


def _noise(section: NoiseSection, acceleration: NoiseStd | None) -> NoiseStd | Noise | None:
    """Return the noise defined in `[model]`. If given, `acceleration` overrides the acceleration noise."""
    stated = section.given() | ({} if acceleration is None else {"acceleration": acceleration})
    if set(stated) <= {"acceleration"}:
        return stated.get("acceleration")
    torque = stated.get("torque", "auto")
    return Noise(**{**stated, "torque": None if torque == "none" else torque})


def _priors(table: ModelTable, written: Sequence[dict[str, Any]]) -> tuple[ForcePrior, ...]:
    """Return the priors defined in `[[model.priors]]`."""
    priors = []
    for i, described in enumerate(written):
        key = ("model", "priors", i)
        prior = table.document.at(key, decode, described, classes(), "prior", whole=False)
        if not isinstance(prior, ForcePrior):
            known = [name for name, part in classes().items() if issubclass(part, ForcePrior)]
            raise SceneError(
                f"{table.document.place(key)}: not a force prior",
                expected=f"type = one of {', '.join(known)}",
                got=described.get("type"),
            )
        priors.append(prior)
    return tuple(priors)


def _learning(table: ModelTable, model: Model[Any]) -> Options | None:
    """Return the options defined in `[model.learning]`, with defaults of the model for missing keys."""
    options: dict[str, Any] = table.section.learning.given()
    if not options:
        return None
    if options.get("warm_start") is False:
        options["warm_start"] = None
    default = _default(model, options)
    known = [field.name for field in dataclasses.fields(default)]
    for key in options:
        what = f"learning a {model.kind} model by {type(default).__name__}"
        _check_key(table, ("model", "learning", key), known, what)
    return table.document.at(("model", "learning"), type(default), **{**vars(default), **options})


def _default(model: Model[Any], options: Mapping[str, Any]) -> Options:
    """Return the default options of a model. For an analytical model, the given keys select their class."""
    if isinstance(model, NeuralNetwork):
        return DEEP if len(model.hidden) > 2 else SHALLOW
    if isinstance(model, AnalyticalModel) and not {"optimizer", "max_evaluations"} & set(options):
        return ADAM
    if isinstance(model, StructuredGP) and model.specification.analytical_parameters is not None:
        return WITH_PARAMETERS
    return LearningOptions()


def _check_key(table: ModelTable, key: tuple[str, ...], known: Sequence[str], what: str) -> None:
    """Raise `SceneError` if a key is not one of the known keys."""
    if key[-1] in known:
        return
    near = near_names(key[-1], known)
    raise SceneError(
        f"{table.document.place(key)}: not a setting of {what}",
        expected=f"one of {', '.join(known)}",
        hint=f"did you mean {near[0]!r}?" if near else None,
    )
