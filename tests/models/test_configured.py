"""The table [model]: it makes the model that the same arguments make in Python, and names what is wrong."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import pytest

from forcegp import Noise
from forcegp.errors import SceneError, UnknownNameError
from forcegp.forces import priors
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.contact import ContactForcePrior, SlidingFrictionPrior
from forcegp.forces.priors.joint import AnalyticalMean, JointForcePrior, JointFrictionPrior
from forcegp.forces.priors.memory import BristlePrior
from forcegp.gp import kernels
from forcegp.gp.kernels import Linear, Matern52, SquaredExponential, Sum
from forcegp.learning.specification import WITH_PARAMETERS
from forcegp.models import Inference, LearningOptions
from forcegp.models.analytical import ADAM, AnalyticalModel, Window
from forcegp.models.configured import Configured, configured, keys_of
from forcegp.models.independent_gp import IndependentGP
from forcegp.models.minibatch import BatchOptions
from forcegp.models.neural import SHALLOW, NeuralNetwork
from forcegp.models.structured_file import classes
from forcegp.models.structured_gp import StructuredGP
from forcegp.scene import load_model_table, load_scene
from forcegp.scene.sections import LearningSection, ModelSection, NoiseSection
from logs import random_log

ROOT = Path(__file__).parents[2]
SCENE = load_scene("kuka_plane")
SYSTEM = SCENE.system()


@pytest.fixture
def made(tmp_path: Path):
    def make(text: str, **options: object) -> Configured:
        path = tmp_path / "model.toml"
        path.write_text(f"[model]\n{text}")
        return configured(load_model_table(path), SYSTEM, **options)  # pyright: ignore[reportArgumentType]

    return make


def test_a_table_without_keys_is_the_default_model(made) -> None:
    found = made("")
    assert found.name == "sgp" and found.options is None
    ours, plain = found.model.specification, StructuredGP(SYSTEM, "analytical").specification
    assert (ours.mean, ours.priors, ours.noise, ours.automatic) == (
        plain.mean, plain.priors, plain.noise, plain.automatic,
    )  # fmt: skip


def test_priors_and_kernels_are_those_of_the_classes(made) -> None:
    found = made("""
name = "sgp-zero"
mean = ["gravity", "actuation"]
inference = "exact"
[model.noise]
acceleration = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]
learn = true
torque = 0.5
state = [1e-3, 1e-2]
[[model.priors]]
type = "joint"
inputs = ["q", "qd"]
kernel = { type = "sum", left = { type = "linear", inputs = ["qd"] }, right = { type = "matern52" } }
[[model.priors]]
type = "contact"
contact = "table"
""")
    spec = found.model.specification
    kernel = Sum(Linear(("qd",)), Matern52())
    assert spec.priors == (JointForcePrior(kernel, ("q", "qd")), ContactForcePrior("table"))
    assert spec.mean == AnalyticalMean(("gravity", "actuation"))
    assert spec.noise == Noise((0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7), True, 0.5, (1e-3, 1e-2))
    assert spec.inference.method == "exact"


def test_robot_parameters_and_learning_of_a_structured_gp(made) -> None:
    found = made("""
noise = { torque = "none" }
analytical_parameters = { damping = "all", mass = ["lbr_iiwa_joint_7"] }
learning = { optimizer = "adam", restarts = 3, warm_start = false }
""")
    spec = found.model.specification
    assert spec.analytical_parameters.joints == {
        "damping": SYSTEM.robot.joint_names,
        "mass": ("lbr_iiwa_joint_7",),
    }
    assert spec.noise.torque is None
    expected = LearningOptions("adam", tolerance=WITH_PARAMETERS.tolerance, restarts=3, warm_start=None)
    assert found.options == expected


def test_noise_with_tails_and_terms(made) -> None:
    found = made("""
noise = { degrees_of_freedom = 4.0 }
inference = { method = "sparse", inducing_points = 7 }
[[model.priors]]
type = "joint_friction"
speeds = [0.05]
[[model.priors]]
type = "joint"
scaled = false
[[model.priors]]
type = "bristles"
[model.learning]
hyperpriors = false
""")
    spec = found.model.specification
    assert (spec.noise.degrees_of_freedom, spec.inference) == (4.0, Inference("sparse", inducing_points=7))
    assert spec.priors == (JointFrictionPrior(speeds=(0.05,)), JointForcePrior(scaled=False), BristlePrior())
    assert found.options == LearningOptions(hyperpriors=False)


def test_the_other_models(made) -> None:
    network = made('name = "nn"\nhidden = [30, 20]\nseed = 4\n[model.learning]\nepochs = 7\n')
    assert isinstance(network.model, NeuralNetwork) and network.model.hidden == (30, 20)
    assert network.model.seed == 4
    assert network.options == BatchOptions(7, SHALLOW.batch, SHALLOW.learning_rate, patience=SHALLOW.patience)
    independent = made('name = "gp"\nnoise = 0.3\n[model.learning]\nmax_evaluations = 5\n')
    assert isinstance(independent.model, IndependentGP) and independent.model.noise == 0.3
    assert independent.options == LearningOptions(max_evaluations=5)
    text = 'name = "analytical"\nanalytical_parameters = { friction = "all" }\nwindow = { relative = 0.2 }\n'
    analytical = made(text + "[model.learning]\nbatch = 64\n").model
    assert isinstance(analytical, AnalyticalModel)
    assert list(analytical.parameters.joints) == ["friction"] and analytical.window == Window(relative=0.2)
    assert made(text + "[model.learning]\nbatch = 64\n").options == BatchOptions(
        ADAM.epochs, 64, ADAM.learning_rate, patience=ADAM.patience
    )
    assert made(text + '[model.learning]\noptimizer = "lbfgs"\n').options == LearningOptions()


def test_options_of_the_caller_override_the_table(made) -> None:
    found = made('name = "nn"\nnoise = 0.1\nseed = 1\n', name="gp", noise_std=0.5, seed=2)
    assert found.name == "gp" and found.model.noise == 0.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('name = "sgp-meen"', r"model\.toml:2: model\.name: unknown model 'sgp-meen'(.|\n)*'sgp-mean'"),
        ('prior = "joint"', r"model\.toml:2: model\.prior: unknown key(.|\n)*did you mean 'priors'"),
        (
            'inference = "magic"',
            r"model\.toml:2: model\.inference: input should be 'auto', 'exact'(.|\n)*'magic'",
        ),
        ("inference = { points = 9 }", r"model\.toml:2: model\.inference(.|\n)*points(.|\n)*inducing_points"),
        ("inference.inducing_points = 0", r"model\.toml:2: model\.inference\.inducing_points: invalid"),
        ('name = "nn"\nmean = "zero"', r"model\.toml:3: model\.mean: not a setting of the model 'nn'"),
        (
            'name = "gp"\n[model.learning]\nepochs = 3',
            r"model\.toml:4: model\.learning\.epochs: not a",
        ),
        (
            "[model.learning]\nrestart = 3",
            r"toml:3: model\.learning\.restart: unknown(.|\n)*'restarts'",
        ),
        ("[model.learning]\nrestarts = -3", r"model\.toml:3: model\.learning\.restarts: (.|\n)*greater"),
        (
            '[model.analytical_parameters]\nmas = "all"',
            r"model\.toml:2: model\.analytical_parameters: (.|\n)*'mas'(.|\n)*'mass'",
        ),
        ("[model.noise]\ntorqe = 0.1", r"model\.toml:3: model\.noise\.torqe: unknown key(.|\n)*'torque'"),
        ("noise = { torque = -1.0 }", r"model\.toml:2: model\.noise\.torque"),
        (
            'name = "gp"\nnoise = { torque = 1.0 }',
            r"model\.toml:1: model: (.|\n)*only white acceleration noise",
        ),
        ('mean = ["gravty"]', r"model\.toml:2: model\.mean: (.|\n)*did you mean 'gravity'"),
        (
            '[[model.priors]]\ntype = "join"',
            r"toml:2: model\.priors\[0\]: (.|\n)*did you mean 'joint'",
        ),
        (
            '[[model.priors]]\ntype = "joint"\nkernell = { type = "linear" }',
            r"model\.toml:2: model\.priors\[0\]: prior: wrong fields of 'joint'(.|\n)*did you mean 'kernel'",
        ),
        (
            '[[model.priors]]\ntype = "joint"\nkernel = { type = "matern", inputs = ["q"] }',
            r"unknown type in prior\.kernel 'matern'(.|\n)*did you mean 'matern",
        ),
        ('[[model.priors]]\ntype = "sliding_friction"', r"wrong fields(.|\n)*contact(.|\n)*got: \[\]"),
        (
            '[[model.priors]]\ntype = "linear"',
            r"priors\[0\]: not a force prior(.|\n)*sliding_friction",
        ),
        (
            '[[model.priors]]\ntype = "contact"\ncontact = "tabel"',
            r"'tabel'(.|\n)*did you mean 'table'",
        ),
    ],
)
def test_what_is_wrong_is_named_with_its_place(made, text: str, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        made(text)


def test_a_model_that_the_caller_misspells_is_not_blamed_on_the_file(made) -> None:
    with pytest.raises(UnknownNameError, match="unknown model 'sgp-men'") as raised:
        made("", name="sgp-men")
    assert "model.toml" not in str(raised.value)


@pytest.mark.parametrize("made", [StructuredGP, AnalyticalModel, NeuralNetwork, IndependentGP])
def test_every_argument_of_a_model_has_a_key(made: type) -> None:
    """What the constructor takes, a table can give; a new argument needs a key."""
    assert set(keys_of(made)) <= set(ModelSection.model_fields)


def test_every_field_of_the_noise_has_a_key() -> None:
    assert {field.name for field in dataclasses.fields(Noise)} == set(NoiseSection.model_fields)


@pytest.mark.parametrize("options", [LearningOptions, BatchOptions])
def test_every_option_of_learning_has_a_key(options: type) -> None:
    assert {field.name for field in dataclasses.fields(options)} <= set(LearningSection.model_fields)


def test_every_prior_and_kernel_of_the_library_can_be_described() -> None:
    """Those that take a function of Python's aside, and what a fit adds of its own."""
    described = set(classes().values())
    for module, base in ((priors, ForcePrior), (kernels, kernels.Kernel)):
        names = [info.name for info in pkgutil.iter_modules(getattr(module, "__path__", []))]
        found = [module, *(importlib.import_module(f"{module.__name__}.{name}") for name in names)]
        made = {
            part
            for place in found
            for part in vars(place).values()
            if isinstance(part, type) and issubclass(part, base) and not inspect.isabstract(part)
        }
        assert {part.__name__ for part in made - described} <= {"OperatorForcePrior", "CoulombErrorPrior"}


def test_the_template_is_valid_and_shows_every_key() -> None:
    path = ROOT / "examples" / "model.toml"
    text = path.read_text()
    for name in (*ModelSection.model_fields, *NoiseSection.model_fields, *LearningSection.model_fields):
        assert re.search(rf"\b{name}\b", text), name
    found = configured(load_model_table(path), load_scene(ROOT / "scenes" / "kuka_sphere.toml").system())
    assert isinstance(found.model, StructuredGP)
    assert [type(prior) for prior in found.model.force_priors][-1] is SlidingFrictionPrior


def test_a_table_learns_what_the_same_arguments_learn(made) -> None:
    data = random_log(40, SYSTEM.robot.joint_names)
    text = '[[model.priors]]\ntype = "joint"\nkernel = { type = "squared_exponential", shared = true }\n'
    found = made(text + "[model.learning]\nmax_evaluations = 5\n").fit(data)
    prior = JointForcePrior(SquaredExponential(shared=True))
    model = StructuredGP(SYSTEM, "analytical", [prior])
    plain = model.fit(data, options=LearningOptions(max_evaluations=5))
    assert found.result.log_marginal_likelihood == plain.result.log_marginal_likelihood
