"""A law of friction that is written once: fit, prediction, rollout, wrench, C, CasADi and files."""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.errors import ForceGPError, ModelError
from forcegp.forces import priors as folder
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.forces.priors.memory import DISTANCES, BristlePrior, bristles
from forcegp.forces.term import Array, JointState, JointTerm, exp
from forcegp.forces.term import log as logarithm
from forcegp.gp.kernels import Columns, Kernel
from forcegp.models.calibrated import calibrated
from forcegp.models.structured_fit import StructuredFit
from forcegp.rollout import RolloutOptions

DRY, DRAG, BUMP = 0.4, 0.3, 0.25
SAME = 1e-9
"""Of the same posterior in PyTorch and in compiled code."""


@dataclass(frozen=True)
class Drag(JointTerm):
    """Drag of a lubricant: dry friction, friction that grows with the square of the speed, and a bump."""

    kernel: Kernel = field(default_factory=Columns)
    name: str = "drag"

    def columns(self, x: JointState) -> dict[str, Array]:
        square = x.qd * x.qd
        return {"dry": x.direction(), "square": square * x.direction(0.1), "bump": x.qd * exp(-square)}


@dataclass(frozen=True)
class Creep(JointTerm):
    """Friction that grows with the logarithm of the speed."""

    kernel: Kernel = field(default_factory=Columns)
    name: str = "creep"

    def columns(self, x: JointState) -> dict[str, Array]:
        return {"creep": x.direction() * logarithm(1.0 + abs(x.qd) / 0.1), "cubic": x.qd**3}


@dataclass(frozen=True)
class Clipped(JointTerm):
    """Friction with a function that only PyTorch has."""

    kernel: Kernel = field(default_factory=Columns)
    name: str = "clipped"

    def columns(self, x: JointState) -> dict[str, Array]:
        return {"clipped": torch.clamp(x.qd, -1.0, 1.0)}  # type: ignore[arg-type]


def force(qd: Tensor) -> Tensor:
    return (
        -DRY * torch.tanh(qd / 0.02) - DRAG * qd**2 * torch.tanh(qd / 0.1) - BUMP * qd * torch.exp(-(qd**2))
    )


def log(seed: int, n: int = 1500) -> tuple[forcegp.ConstrainedSystem, forcegp.Dataset]:
    robot = forcegp.load_robot("double_pendulum")
    robot = robot.replace(damping=0.0 * robot.damping, friction=0.0 * robot.friction)
    generator = torch.Generator().manual_seed(seed)
    t = 0.01 * torch.arange(n, dtype=torch.float64)
    w = 0.5 + 3.0 * torch.rand(4, 2, generator=generator, dtype=torch.float64)
    angle = w * t[:, None, None] + 6.3 * torch.rand(4, 2, generator=generator, dtype=torch.float64)
    q, qd, qdd = (0.5 * x.sum(1) for x in (angle.sin(), w * angle.cos(), -(w**2) * angle.sin()))
    noise = 0.05 * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    tau = forcegp.dynamics.inverse_dynamics(robot, q, qd, qdd) - force(qd) + noise
    return forcegp.ConstrainedSystem(robot), forcegp.Dataset(t, q, qd, tau, qdd, robot.joint_names)


@pytest.fixture(scope="module")
def fit():
    system, data = log(0)
    return forcegp.StructuredGP(system, "analytical", [Drag()]).fit(data)


def test_the_law_is_learned_with_bars(fit) -> None:
    _, test = log(1, 300)
    found = fit.predict(test.q, test.qd, test.tau, "joint_friction")
    error = found.mean - force(test.qd)
    assert float(error.square().mean().sqrt()) < 0.03
    assert float((error.abs() <= 2.0 * found.std + 1e-3).double().mean()) > 0.85
    torch.testing.assert_close(fit.torque_std, torch.full_like(fit.torque_std, 0.05), rtol=0.1, atol=0.0)


def test_a_saved_law_keeps_its_parameters(fit, tmp_path: Path) -> None:
    """Files do not keep the order of the columns, so one load may be right by chance."""
    fit.save(tmp_path / "model")
    for _ in range(10):
        again = forcegp.load_model(tmp_path / "model")
        assert isinstance(again, StructuredFit) and again.parameters() == fit.parameters()


def test_a_law_that_is_not_imported_is_named_with_a_hint(
    fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit.save(tmp_path / "model")
    monkeypatch.delitem(JointTerm.laws, "drag")
    parts = (
        r"unknown type in .*priors\.0 'drag'",
        "expected: one of .*joint_friction.*",
        "hint: import the module that defines it before loading",
    )
    with pytest.raises(ForceGPError, match=r"\n  ".join(parts)):
        forcegp.load_model(tmp_path / "model")


def test_all_laws_of_the_library_are_public() -> None:
    """`forcegp.priors` imports them, so that saved models are read with all of them."""
    for module in pkgutil.iter_modules(folder.__path__, folder.__name__ + "."):
        importlib.import_module(module.name)
    laws = [law for law in JointTerm.laws.values() if law.__module__.startswith(f"{folder.__name__}.")]
    assert len(laws) >= 4 and all(getattr(forcegp.priors, law.__name__) is law for law in laws)


def test_laws_may_use_magnitudes_powers_and_logarithms() -> None:
    """In C with Jacobians by automatic differentiation, and in PyTorch."""
    (system, data), (_, test) = log(0, 400), log(2, 20)
    fit = forcegp.StructuredGP(system, "analytical", [Creep()]).fit(data)
    one, two = fit.predict(test.q, test.qd, test.tau), fit.compiled().predict(test.q, test.qd, test.tau)
    torch.testing.assert_close(two.mean, one.mean, rtol=SAME, atol=SAME)
    torch.testing.assert_close(two.covariance, one.covariance, rtol=1e-7, atol=SAME)


def test_a_law_without_a_form_in_c_is_named() -> None:
    system, data = log(0, 300)
    fit = forcegp.StructuredGP(system, "analytical", [Clipped()]).fit(data)
    with pytest.raises(ModelError, match="'clipped' have no form in C and CasADi"):
        fit.compiled()


def test_a_law_with_the_name_of_another_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"'joint_friction' of .*Second is that of JointFrictionPrior"):

        class Second(JointTerm):
            name: str = "joint_friction"

    @dataclass(frozen=True)
    class Inherits(JointFrictionPrior):
        """It has no name of its own, so that files keep that of its base."""

    assert JointTerm.laws["joint_friction"] is JointFrictionPrior
    system, data = log(0, 300)
    fit = forcegp.StructuredGP(system, "analytical", [JointFrictionPrior()]).fit(data, learn=[])
    fit.save(tmp_path / "model")
    again, state = forcegp.load_model(tmp_path / "model"), (data.q[0], data.qd[0], data.tau[0])
    torch.testing.assert_close(again.predict(*state).mean, fit.predict(*state).mean, rtol=SAME, atol=SAME)


CELL = """
@dataclass(frozen=True)
class Cell(JointTerm):
    kernel: Kernel = field(default_factory=Columns)
    name: str = "residual"

    def columns(self, x):
        return {"load": x.qd, "dry": x.direction()}
"""


def test_a_law_that_a_notebook_defines_again_is_saved(tmp_path: Path) -> None:
    """Its name is that of a prior of the library, and the name of a column that of a library column."""
    system, data = log(7, 300)
    exec(CELL, globals())
    model = forcegp.StructuredGP(system, "analytical", [globals()["Cell"]()]).fit(data)
    exec(CELL, globals())
    path = tmp_path / "model.safetensors"
    model.save(path)
    again, states = forcegp.load_model(path), (data.q, data.qd, data.tau)
    assert torch.equal(again.predict(*states).mean, model.predict(*states).mean)
    assert model.parameters()[0].unit == "N m per unit of load"
    exec(CELL.replace("x.qd,", "x.qd * abs(x.qd),"), globals())
    with pytest.raises(ModelError, match="not those that the model was fitted with"):
        forcegp.load_model(path)


@pytest.mark.parametrize(
    "column",
    ["1.0", "x.qd[:, 0]", "logarithm(x.qd)"],
    ids=["number", "one joint", "not a number"],
)
def test_columns_that_are_not_valid_are_named_before_the_fit(column: str) -> None:
    system, _ = log(7, 300)
    exec(CELL.replace("x.qd,", f"{column},"), globals())
    with pytest.raises(ModelError, match="column 'load' of force prior 'residual' is not valid"):
        forcegp.StructuredGP(system, "analytical", [globals()["Cell"]()])


def test_a_law_without_a_kernel_is_refused() -> None:
    system, _ = log(7, 300)

    class Plain(JointTerm):
        def columns(self, x: JointState) -> dict[str, Array]:
            return {"viscous": x.qd}

    with pytest.raises(ModelError, match="Plain is not a valid force prior"):
        forcegp.StructuredGP(system, "analytical", [Plain()])


def test_compiled_code_and_casadi_read_the_same_lines(fit, tmp_path: Path) -> None:
    _, test = log(2, 20)
    state = test.q, test.qd, test.tau
    one, two = fit.predict(*state), fit.compiled().predict(*state)
    torch.testing.assert_close(two.mean, one.mean, rtol=SAME, atol=SAME)
    torch.testing.assert_close(two.covariance, one.covariance, rtol=1e-7, atol=SAME)
    casadi = pytest.importorskip("casadi")
    folder = fit.export(tmp_path / "casadi", language="casadi", name="law").folder
    (file,) = folder.glob("*.casadi")
    function = casadi.Function.load(str(file))
    values = function(*(x[3].numpy() for x in state), *([] if function.n_in() == 3 else [[]]))
    first = values[0] if isinstance(values, tuple) else values
    torch.testing.assert_close(torch.from_numpy(first.full()[:, 0]), one.mean[3], rtol=SAME, atol=SAME)


def test_rollouts_wrenches_and_files_know_the_law(fit, tmp_path: Path) -> None:
    _, test = log(3, 200)
    still = torch.zeros(2, dtype=torch.float64)
    rest = fit.rollout(0.005 + still, still, lambda t, q, qd: 0.0 * q, 0.3, options=RolloutOptions(dt=5e-3))
    assert float(rest.qd[-1].abs().max()) == 0.0, "dry friction holds a joint that barely hangs askew"
    frame = fit.system.robot.frame_names[-1]
    wrench = fit.external_wrench(test, frame, axes=("fx",))
    assert float(wrench.mean.square().mean().sqrt()) < 0.3, "no force but friction acts"
    fit.save(tmp_path / "model")
    again = forcegp.load_model(tmp_path / "model")
    state = test.q[:5], test.qd[:5], test.tau[:5]
    torch.testing.assert_close(again.predict(*state).mean, fit.predict(*state).mean, rtol=SAME, atol=SAME)


def test_the_robot_file_holds_what_it_can_of_the_law(fit) -> None:
    found = calibrated(fit)
    expected = force(found.speeds)
    torch.testing.assert_close(found.friction, expected, rtol=0.0, atol=0.05)
    assert bool((found.robot.damping > 0.2).all()), "the parabola is best met by a line"


def test_parameters_are_the_weights_of_the_columns(fit) -> None:
    """Their sum is the force, and each is the true one within its bars."""
    table = {each.name: each for each in fit.parameters()}
    names = ("dry", "square", "bump")
    assert set(table) == {
        f"drag.{name} of {joint}" for name in names for joint in fit.system.robot.joint_names
    }
    for joint in fit.system.robot.joint_names:
        for name, true in zip(names, (-DRY, -DRAG, -BUMP), strict=True):
            found = table[f"drag.{name} of {joint}"]
            assert abs(found.value - true) < 4.0 * found.std + 0.02
            assert found.unit == f"N m per unit of {name}" and found.determined
    qd = torch.tensor([[0.3, -1.2]], dtype=torch.float64)
    columns = Drag().columns(JointState(qd, qd, qd))
    sums = [
        sum(float(columns[name][0, j]) * table[f"drag.{name} of {joint}"].value for name in names)
        for j, joint in enumerate(fit.system.robot.joint_names)
    ]
    read = fit.predict(0.0 * qd, qd, 0.0 * qd, "joint_friction").mean[0]
    torch.testing.assert_close(torch.tensor(sums, dtype=torch.float64), read, rtol=1e-9, atol=1e-12)


def test_bristles_follow_dahls_law_along_a_log() -> None:
    generator = torch.Generator().manual_seed(0)
    n = 400
    t = 0.01 * torch.arange(n, dtype=torch.float64)
    qd = torch.randn(n, 2, generator=generator, dtype=torch.float64).cumsum(0) * 0.1
    segment = (torch.arange(n) >= 150).long()
    z, unknown = bristles(t, qd, segment).chunk(2, dim=-1)
    expected, travel = (
        torch.zeros(2, len(DISTANCES), dtype=torch.float64),
        torch.zeros(2, dtype=torch.float64),
    )
    for k in range(n):
        if k in (0, 150):
            expected, travel = 0.0 * expected, 0.0 * travel
        else:
            step = (t[k] - t[k - 1]) * 0.5 * (qd[k] + qd[k - 1])
            travel = travel + step.abs()
            a = torch.exp(-step.abs()[:, None] / torch.tensor(DISTANCES, dtype=torch.float64))
            expected = a * expected + (1.0 - a) * step.sign()[:, None]
        torch.testing.assert_close(z[k], expected, rtol=0.0, atol=1e-12)
        left = torch.exp(-(travel[:, None] / torch.tensor(DISTANCES, dtype=torch.float64)).clamp(max=300.0))
        torch.testing.assert_close(unknown[k], left, rtol=1e-9, atol=1e-12)
    shuffled = torch.randperm(n, generator=generator)
    again = bristles(t[shuffled], qd[shuffled], segment[shuffled])
    torch.testing.assert_close(again, torch.cat([z, unknown], dim=-1)[shuffled])


def test_a_state_without_past_has_no_bristles_and_their_variance() -> None:
    """Friction with memory: along the log it is followed, at single states it is an unknown force."""
    system, data = log(4)
    z = bristles(data.t, data.qd, data.segment)[..., 2]
    remembering = data.replace(tau=data.tau + force(data.qd) + 0.8 * z)
    fit = forcegp.StructuredGP(system, "analytical", inertia="file").fit(remembering)
    assert any(isinstance(prior, BristlePrior) for prior in fit.force_priors)
    along = fit.predict_log(remembering, "joint_force")
    single = fit.predict(data.q, data.qd, remembering.tau, "joint_force")
    M = forcegp.dynamics.mass_matrix(system.robot, data.q)
    at = system.equations(data.q, data.qd)
    true = (M @ data.qdd[..., None])[..., 0]
    assert at.Q_G.shape == true.shape
    errors = [(x.mean - true).square().mean().sqrt() for x in (along, single)]
    assert float(errors[0]) < 0.6 * float(errors[1])
    noisy = fit.predict(data.q, data.qd, remembering.tau, "joint_force", noise=True)
    inside = ((noisy.mean - true).abs() <= 2.0 * noisy.std).double().mean()
    assert 0.85 < float(inside) < 0.99
