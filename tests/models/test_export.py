"""A fit as C: the numbers of `predict`, no warnings of compilers, and what cannot be exported."""

from __future__ import annotations

import ctypes
import dataclasses
import json
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

import forcegp
from forcegp import dynamics
from forcegp.cli.app import app
from forcegp.destination import MANIFEST
from forcegp.errors import (
    DestinationError,
    ForceGPError,
    ModelError,
    NumericalError,
    ParameterError,
    ShapeError,
    UnknownNameError,
)
from forcegp.forces.posterior import unknown_variance
from forcegp.forces.priors.contact import ContactForcePrior, NormalForcePrior, SlidingFrictionPrior
from forcegp.forces.priors.inertial import InertialPrior, PayloadPrior
from forcegp.forces.priors.joint import JointForcePrior, JointFrictionPrior
from forcegp.forces.priors.sets import WHOLE, default_priors, friction_priors
from forcegp.forces.quantities import QUANTITIES, states_at
from forcegp.gp.kernels import Linear, Matern32, Matern52, SquaredExponential
from forcegp.gp.sparse import SparsePosterior
from forcegp.models.export.library import CompiledFit
from forcegp.models.export.source import c_source
from forcegp.models.prediction import Prediction
from forcegp.models.structured_fit import StructuredFit
from forces.cases import draw, friction_and_residual, logged, mixed_contacts, two_contacts
from slow import slow_except

SAME = 1e-10  # of max(|mean|, σ); the sums are the same in another order
ZERO = 1e-5  # of the largest component of a state: SAME times that is 5 ε of it, rounding of zeros
STRICT = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror"]
ALL = list(QUANTITIES)

COMPILERS = [
    pytest.param(name, marks=pytest.mark.skipif(shutil.which(name) is None, reason=f"needs {name}"))
    for name in ("gcc", "clang")
]
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")


def free_log(robot: forcegp.RobotModel, n: int) -> forcegp.Dataset:
    q, qd, tau = draw(n, 3)
    noise = 0.1 * torch.randn(n, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    qdd = dynamics.forward_dynamics(robot, q, qd, tau - 2.0 * torch.tanh(qd / 0.1) - qd) + noise
    return forcegp.Dataset(0.1 * torch.arange(n).double(), q, qd, tau, qdd, robot.joint_names)


def free_friction() -> StructuredFit:
    """The default model of a measured robot with polynomial damping, with everything that it learns."""
    robot = forcegp.load_robot("kuka_iiwa")
    robot = robot.replace(drag=robot.mass.new_tensor([[0.2, 0.3]]).expand(robot.nq, 2))
    system = forcegp.ConstrainedSystem(robot)
    model = forcegp.StructuredGP(system, mean="analytical", force_priors=friction_priors(system))
    return model.fit(free_log(robot, 120), options=forcegp.models.LearningOptions(max_evaluations=15))


def free_inertial() -> StructuredFit:
    """Uncertain inertia of links and drives, marginalised."""
    robot = forcegp.load_robot("kuka_iiwa")
    priors = [JointFrictionPrior(), InertialPrior().with_drives(torch.full((7,), 0.05))]
    model = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot), "analytical", priors, noise=0.1)
    return model.fit(free_log(robot, 60), learn=[])


def uncertain_inertia() -> StructuredFit:
    """The same, where predictions follow the robot file and the errors of its inertia widen their bars."""
    robot = forcegp.load_robot("kuka_iiwa")
    errors = InertialPrior(is_error=True).with_drives(torch.full((7,), 0.05))
    priors = [JointFrictionPrior(), errors]
    model = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot), "analytical", priors, noise=0.1)
    return model.fit(free_log(robot, 60), learn=[])


def one_contact() -> StructuredFit:
    """Friction of the joints and, coupled with the multiplier, of a contact."""
    system = forcegp.ConstrainedSystem(
        two_contacts().robot, two_contacts().contacts[:1], forcegp.constraints.Baumgarte()
    )
    noise = forcegp.Noise(0.1, torque=0.3, external={"lbr_iiwa_joint_2": 0.5})
    model = forcegp.StructuredGP(system, "analytical", friction_priors(system), noise=noise)
    return model.fit(logged(two_contacts(), 60), learn=[])


def sparse() -> StructuredFit:
    """Inducing points of a residual force, in two contacts."""
    priors = friction_and_residual()
    sparse = forcegp.models.Inference("sparse", inducing_points=12)
    model = forcegp.StructuredGP(two_contacts(), "analytical", priors, inference=sparse)
    return model.fit(logged(two_contacts(), 80), learn=[])


def exact() -> StructuredFit:
    """The same by exact inference."""
    model = forcegp.StructuredGP(two_contacts(), "analytical", friction_and_residual(), inference="exact")
    return model.fit(logged(two_contacts(), 16), learn=[])


def zero_mean() -> StructuredFit:
    """The whole force: products of linear and stationary kernels, sines of angles."""
    priors = (JointForcePrior(WHOLE, periodic=True), *default_priors(two_contacts(), "zero")[1:])
    priors = (priors[0], NormalForcePrior(priors[0]))
    sparse = forcegp.models.Inference("sparse", inducing_points=12)
    model = forcegp.StructuredGP(two_contacts(), "zero", priors, noise=0.1, inference=sparse)
    return model.fit(logged(two_contacts(), 50), learn=[])


def every_friction() -> StructuredFit:
    """All kinds of sliding friction on a ball, any force on a table, Matérn kernels."""
    terms = ("viscous", "dry", "coulomb", "stribeck", "torsion")
    priors = [
        JointForcePrior(
            Matern32(("q",)) + Matern52(("qd",), shared=True) * Linear(("qd",)), inputs=("q", "qd")
        ),
        ContactForcePrior("table", Linear(("velocity",)) + SquaredExponential()),
        SlidingFrictionPrior(
            "ball", inputs=("position", "velocity", "speed"), terms=terms, friction_coefficient=0.1
        ),
    ]
    model = forcegp.StructuredGP(two_contacts(), "analytical", priors, noise=0.1, inference="exact")
    return model.fit(logged(two_contacts(), 14), learn=[])


def rounded_tip() -> StructuredFit:
    """A ball of a tip on a sphere, and one on a cylinder."""
    robot = forcegp.load_robot("kuka_iiwa")
    tip = forcegp.SurfaceContact(
        "tip", "lbr_iiwa_link_7", (0, 0, 0.1), forcegp.constraints.Sphere((0.5, 0.1, -0.3), 0.4), radius=0.02
    )
    pipe = forcegp.constraints.Cylinder((0.3, -0.2, 0.1), (0.1, 1.0, 0.3), 0.1)
    side = forcegp.SurfaceContact("side", "lbr_iiwa_link_5", (0.05, 0, 0.1), pipe, radius=0.03)
    system = forcegp.ConstrainedSystem(robot, [tip, side])
    model = forcegp.StructuredGP(system, "analytical", friction_priors(system), noise=0.1)
    contact = {"tip": mixed_contacts(40)[:, 0], "side": mixed_contacts(40)[:, 1]}
    return model.fit(free_log(robot, 40).replace(contact=contact), learn=[])


def undetermined() -> StructuredFit:
    """Contacts that share a load, one that is never closed, and one that cannot move."""
    robot, up = forcegp.load_robot("kuka_iiwa"), forcegp.Plane()
    at = {"a": ("lbr_iiwa_link_7", 0.1), "b": ("lbr_iiwa_link_7", 0.1)}
    at |= {"never": ("lbr_iiwa_link_5", 0.1), "base": ("lbr_iiwa_link_0", 0.1)}
    contacts = [forcegp.SurfaceContact(name, frame, (0, 0, z), up) for name, (frame, z) in at.items()]
    closed = {name: mixed_contacts(40)[:, int(name == "b")] for name in at}
    closed["never"] = torch.zeros(40, dtype=torch.bool)
    system = forcegp.ConstrainedSystem(robot, contacts)
    model = forcegp.StructuredGP(system, "analytical", friction_priors(system), 0.1)
    return model.fit(free_log(robot, 40).replace(contact=closed), learn=[])


CASES: dict[str, Callable[[], StructuredFit]] = {
    f.__name__: f
    for f in (
        free_friction,
        free_inertial,
        uncertain_inertia,
        one_contact,
        sparse,
        exact,
        zero_mean,
        every_friction,
        rounded_tip,
    )
}
MORE: dict[str, Callable[[], StructuredFit]] = {"undetermined": undetermined}


@cache
def fitted(name: str) -> StructuredFit:
    return (CASES | MORE)[name]()


@cache
def compiled(name: str) -> CompiledFit:
    return fitted(name).compiled()


def states(fit: StructuredFit, n: int = 24) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """States between and beyond those of the training data, with all patterns of contacts."""
    return draw(n, 11), mixed_contacts(n)[:, : len(fit.system.contacts)]


def floored(size: Tensor) -> Tensor:
    """Sizes of components of each state, none of them below `ZERO` of the largest."""
    return size.maximum(ZERO * size.amax(-1, keepdim=True)).clamp(min=1e-300)


def differences(ours: Prediction, theirs: Prediction) -> tuple[float, float]:
    """Largest difference of means and of standard deviations, in units of max(|mean|, σ)."""
    assert ours.covariance is not None and theirs.covariance is not None and theirs.std is not None
    size = floored(theirs.mean.abs().maximum(theirs.std))
    std = floored(theirs.std)
    in_mean = (ours.mean - theirs.mean).abs() / size
    in_covariance = (ours.covariance - theirs.covariance).abs() / (std[..., None] * std[..., None, :])
    return float(in_mean.max()), 0.5 * float(in_covariance.max())


@pytest.mark.parametrize("name", slow_except(CASES, "free_friction", "one_contact", "exact"))
def test_the_numbers_of_predict(name: str) -> None:
    fit, fast = fitted(name), compiled(name)
    state, active = states(fit)
    for quantity in (*ALL, ALL):
        for noise in (False, True):
            theirs = fit.predict(*state, quantity, active=active, noise=noise)
            if not theirs.mean.numel():
                continue
            ours = fast.predict(*state, quantity, active=active, noise=noise)
            if float(theirs.mean.abs().max()) == 0.0:
                assert float(ours.mean.abs().max()) == 0.0
                continue
            assert max(differences(ours, theirs)) < SAME, quantity
            assert ours.parts == theirs.parts
    mean = fit.predict(*state, ALL, active=active, covariance=False)
    ours = fast.predict(*state, ALL, active=active, covariance=False)
    assert ours.covariance is None
    assert float(((ours.mean - mean.mean).abs() / floored(mean.mean.abs())).max()) < SAME
    if mean.beyond is not None:
        torch.testing.assert_close(ours.beyond, mean.beyond, rtol=1e-12, atol=0.0)
        assert float(mean.beyond.max()) > 0.0, "some states lie beyond the trained region"


def test_the_models_are_what_they_are_meant_to_be() -> None:
    assert fitted("sparse").result.inference == "sparse" and fitted("exact").result.inference == "exact"
    latent = fitted("sparse").posterior.latent
    assert isinstance(latent, SparsePosterior) and any(part.spectra for part in latent.basis.parts)
    assert fitted("free_friction").torque_std is not None
    assert fitted("one_contact").posterior.process.coulomb
    state, _ = states(fitted("free_inertial"))
    means = [fitted(name).predict(*state).mean for name in ("free_inertial", "uncertain_inertia")]
    assert float((means[0] - means[1]).abs().max()) > 0.1


@pytest.mark.slow
def test_batches_and_single_states() -> None:
    fit, fast = fitted("sparse"), compiled("sparse")
    state, active = states(fit)
    flat = fast.predict(*state, ["multiplier", "qdd"], active=active)
    grid = fast.predict(
        *(x.reshape(4, 6, 7) for x in state), ["multiplier", "qdd"], active=active.reshape(4, 6, 2)
    )
    assert torch.equal(grid.mean.flatten(0, 1), flat.mean) and grid.covariance is not None
    turned = fast.predict(*(x.mT.contiguous().mT for x in state), ["multiplier", "qdd"], active=active)
    assert torch.equal(turned.mean, flat.mean)
    rest = fast.predict(state[0], 0.0 * state[1][0], state[2], active=active)
    torch.testing.assert_close(rest.mean, fit.predict(state[0], 0.0 * state[1], state[2], active=active).mean)
    closed = fast.predict(*state).mean
    assert torch.equal(closed, fast.predict(*state, active=torch.ones(2, dtype=torch.bool)).mean)
    one = fast.predict(*(x[3] for x in state), ["multiplier", "qdd"], active=active[3])
    assert torch.equal(one.mean, flat.mean[3]) and one.mean.shape == (9,)
    assert fast.predict(*(x[:0] for x in state)).mean.shape == (0, 7)
    swapped = fast.predict(*state, ["qdd", "multiplier"], active=active)
    assert list(swapped.parts) == ["qdd", "multiplier"] and list(flat.parts) == ["multiplier", "qdd"]
    assert torch.equal(swapped.mean, flat.mean.roll(-2, dims=-1)) and flat.covariance is not None
    assert torch.equal(swapped.covariance, flat.covariance.roll((-2, -2), dims=(-2, -1)))


def log_of(fit: StructuredFit) -> forcegp.Dataset:
    m, t = fit.training.measurements[0], torch.arange(len(fit.training.measurements[0].q)).double()
    closed = dict(zip(fit.system.contact_names, m.active.mT, strict=True))
    return forcegp.Dataset(t, m.q, m.qd, m.tau, m.values, fit.system.robot.joint_names, contact=closed)


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 2])
def test_undetermined_forces_are_those_of_the_fit(first: int) -> None:
    fit, n = fitted("undetermined"), 16
    fast, state, active = compiled("undetermined"), draw(n, 11), mixed_contacts(n).repeat(1, 2)
    assert fit.result.never_closed == ("never",)
    if first:
        log = log_of(fit)[:first]
        log = log.replace(contact={**log.contact, "never": torch.tensor([False, True])})
        for i in range(first):
            fit = fit.update(log[i : i + 1])
        fast = fast.update(log.q, log.qd, log.tau, log.qdd, active=log.active(fit.system.contact_names))
        assert fit.result.never_closed == ()
    some = ["contact_force", "multiplier", "qdd"]
    for quantity in (["multiplier"], some, ["constraint_force", "qdd"], ALL):
        theirs = fit.predict(*state, quantity, active=active)
        ours = fast.predict(*state, quantity, active=active)
        assert ours.doubts == theirs.doubts and ours.mean.isnan().equal(theirs.mean.isnan())
        assert (ours.determined is None) == (theirs.determined is None)
        assert theirs.determined is None or torch.equal(ours.determined, theirs.determined)
        assert theirs.covariance is not None and ours.covariance is not None
        assert ours.covariance.isnan().equal(theirs.covariance.isnan())
        known = [Prediction(x.mean.nan_to_num(), x.covariance.nan_to_num()) for x in (ours, theirs)]  # type: ignore[union-attr]
        assert max(differences(*known)) < SAME
        assert quantity[0] == "constraint_force" or any("same direction" in doubt for doubt in ours.doubts)
    if not first:
        for predictor in (fit, fast):
            with pytest.raises(ModelError, match="contact never is never closed"):
                predictor.predict(*state, "constraint_force", active=active)


@pytest.mark.slow
@needs_gcc
def test_the_test_program_expects_undetermined_forces(tmp_path: Path) -> None:
    folder = fitted("undetermined").export(tmp_path / "c").folder
    ran = built(folder, "-O1")
    assert ran.returncode == 0, ran.stdout
    path = folder / "controller.c"
    path.write_text(path.read_text().replace("if (lost[a]) mean[a] = NAN;", "if (lost[a]) mean[a] = 0.0;"))
    assert built(folder, "-O1").returncode == 1


@pytest.mark.parametrize("name", ["one_contact", "exact", "zero_mean"])
def test_states_beyond_the_training_data_are_flagged_without_learned_noise(name: str) -> None:
    fit = fitted(name)
    q, qd, tau = (x[0] for x in states(fit)[0])
    for predictor in (fit, compiled(name)):
        far = predictor.predict(q, 100.0 * qd, tau)
        assert far.beyond is not None and float(far.beyond.max()) > 30.0
        assert "beyond the trained speeds" in far.warnings[0]
    m = fit.training.measurements[0]
    inside = fit.predict(m.q, m.qd, m.tau, active=m.active).beyond
    assert inside is not None and float(inside.max()) < 1.0


def test_the_trained_region_is_that_of_the_last_fit() -> None:
    robot = forcegp.load_robot("kuka_iiwa")
    model = forcegp.StructuredGP(
        forcegp.ConstrainedSystem(robot), "analytical", [JointFrictionPrior()], noise=0.1
    )
    slow = free_log(robot, 20)
    fast, few = slow.replace(qd=3.0 * slow.qd), forcegp.models.LearningOptions(max_evaluations=2)
    first = model.fit(slow, learn=[])
    second = model.fit(fast, learn=["joint_friction"], after=first, options=few)
    before, after = (x.predict(fast.q, fast.qd, fast.tau).beyond for x in (first, second))
    assert before is not None and after is not None
    assert float(before.max()) > 2.0 and float(after.max()) < 1.0


@pytest.mark.slow
def test_friction_of_the_joints() -> None:
    fit = fitted("free_inertial")
    state, _ = states(fit)
    ours = compiled("free_inertial").predict(*state, "joint_friction")
    at, _ = states_at(fit.system, *state, None)
    learned = fit.posterior.unknown_force(fit.system, at, [0])
    torch.testing.assert_close(ours.mean, learned + at.eom.Q_D, rtol=1e-10, atol=1e-12)
    rows = fit.posterior.rows(fit.system, at, QUANTITIES["joint_force"](fit.system, at))
    only = tuple(W if p == 0 else torch.zeros_like(W) for p, W in enumerate(rows.operators))
    spread = fit.posterior.latent.covariance(type(rows)(rows.features, only, rows.target))
    spread = spread + torch.diag_embed(unknown_variance(fit.hyperparameters, at, None))
    torch.testing.assert_close(ours.covariance, spread, rtol=1e-9, atol=1e-12)
    same = fit.predict(*state, "joint_friction")
    torch.testing.assert_close(same.mean, ours.mean, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(same.covariance, ours.covariance, rtol=1e-9, atol=1e-12)


def test_forward_dynamics_of_the_robot_alone() -> None:
    fit, fast = fitted("free_friction"), compiled("free_friction")
    q, qd, force = (x[0].contiguous() for x in states(fit)[0])
    out = torch.empty(7, dtype=torch.float64)
    pointers = [ctypes.c_void_p(x.data_ptr()) for x in (q, qd, force, out)]
    fast.library.forcegp_forward_dynamics(*pointers)
    torch.testing.assert_close(
        out, dynamics.forward_dynamics(fit.system.robot, q, qd, force), rtol=1e-10, atol=0.0
    )


def built(folder: Path, *flags: str, compiler: str = "gcc") -> subprocess.CompletedProcess[str]:
    """Compile the code and its test program without a warning, and run it."""
    command = [compiler, *STRICT, *flags, "controller.c", "test_controller.c", "-o", "run", "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:3000]
    return subprocess.run([str(folder / "run")], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize(
    "name", slow_except(["free_inertial", "zero_mean", "every_friction", "rounded_tip"], "every_friction")
)
def test_the_folder_compiles_without_warnings_and_passes_its_test(
    name: str, compiler: str, tmp_path: Path
) -> None:
    written = fitted(name).export(tmp_path / "c")
    names = {"controller.h", "controller.c", "test_controller.c", "CMakeLists.txt", "README.md", MANIFEST}
    assert {path.name for path in written.folder.iterdir()} == names
    assert len((written.folder / "README.md").read_text().splitlines()) <= 10
    ran = built(written.folder, "-O2")
    assert ran.returncode == 0, ran.stdout
    source = (written.folder / "controller.c").read_text()
    assert "malloc" not in source
    for line in source.splitlines():
        assert not line.startswith("static double ") or "(" in line, "global state that can change"


@pytest.mark.slow
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", slow_except(["sparse", "exact"], "exact"))
def test_sanitizers_find_nothing(name: str, compiler: str, tmp_path: Path) -> None:
    folder = fitted(name).export(tmp_path / "c").folder
    sanitized = ["-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    ran = built(folder, *sanitized, compiler=compiler)
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.slow
@needs_gcc
def test_the_test_program_finds_a_wrong_number(tmp_path: Path) -> None:
    folder = fitted("one_contact").export(tmp_path / "c").folder
    path, robot = folder / "controller.c", fitted("one_contact").system.robot
    text = path.read_text()
    wrong = repr(float(robot.mass[3]) * 1.001)
    assert repr(float(robot.mass[3])) in text
    path.write_text(text.replace(repr(float(robot.mass[3])), wrong))
    assert built(folder, "-O1").returncode == 1


@pytest.mark.slow
@needs_gcc
def test_two_models_fit_into_one_program(tmp_path: Path) -> None:
    for name in ("left", "right"):
        fitted("one_contact").export(tmp_path / name, name=name)
    main = '#include "left/left.h"\n#include "right/right.h"\n'
    main += "int main(void) { return left_size(LEFT_QDD) == 7 && right_size(RIGHT_QDD) == 7 ? 0 : 1; }\n"
    (tmp_path / "main.c").write_text(main)
    command = ["gcc", *STRICT, "main.c", "left/left.c", "right/right.c", "-o", "run", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    assert subprocess.run([str(tmp_path / "run")], check=False).returncode == 0


@pytest.mark.slow
@needs_gcc
@pytest.mark.parametrize("name", slow_except(["sparse", "exact"], "exact"))
def test_a_reduced_covariance_is_wider_by_no_more_than_stated(name: str, tmp_path: Path) -> None:
    fit = fitted(name)
    written = fit.export(tmp_path / "c", functions=30)
    assert written.functions == 30 and 0.0 < written.wider <= written.widest
    assert f"{written.widest:.2g}" in (written.folder / "README.md").read_text()
    ran = built(written.folder, "-O2")
    assert ran.returncode == 0, ran.stdout
    small, m = fit.compiled(functions=30), fit.training.measurements[0]
    read = [x.predict(m.q, m.qd, m.tau, ["qdd", "multiplier"], active=m.active) for x in (small, fit)]
    torch.testing.assert_close(read[0].mean, read[1].mean, rtol=1e-9, atol=1e-9)
    ours, theirs = (x.std for x in read)
    assert ours is not None and theirs is not None
    growth = (ours / theirs - 1.0)[theirs > ZERO * theirs.max()]
    assert float(growth.min()) > -SAME
    assert float(growth.max()) == pytest.approx(written.widest, rel=1e-6)


@needs_gcc
def test_a_large_posterior_is_reduced_by_default_and_the_loss_is_stated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = fitted("sparse")
    monkeypatch.setattr("forcegp.models.export.model.LARGEST", 20)
    monkeypatch.setattr("forcegp.models.export.model.REDUCED", 12)
    written, size = fit.export(tmp_path / "own"), fit._exported(None).size
    assert written.functions == 12 and f"keeps 12 of {size} functions: at training states" in written.loss
    assert written.loss in (tmp_path / "own" / "README.md").read_text()
    assert f"at most {written.widest:.2g} (median: {written.wider:.2g})" in written.loss

    # The stated loss is that of the code at the training states, and the mean is that of the fit.
    [m] = fit.training.evenly(200).measurements
    ran, small = built(written.folder, "-O2"), fit.compiled(functions=12)
    assert ran.returncode == 0, ran.stdout
    read = [x.predict(m.q, m.qd, m.tau, ["qdd", "multiplier"], active=m.active) for x in (small, fit)]
    torch.testing.assert_close(read[0].mean, read[1].mean, rtol=1e-9, atol=1e-9)
    ours, theirs = (x.std for x in read)
    assert ours is not None and theirs is not None
    growth = (ours / theirs - 1.0)[theirs > ZERO * theirs.max()]
    assert float(growth.max()) == pytest.approx(written.widest, rel=1e-6)
    assert float(growth.median()) == pytest.approx(written.wider, rel=1e-6)

    # A file with sums has no training states.
    fit.save(tmp_path / "model")
    command = ["export", "--model", str(tmp_path / "model"), "--out", str(tmp_path / "c"), "--json"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert said["functions"] == 12 and f"keeps 12 of {size} functions: at random states" in said["loss"]
    assert said["loss"] in " ".join((tmp_path / "c" / "README.md").read_text().split())


@pytest.mark.slow
def test_more_functions_lose_less() -> None:
    fit = fitted("sparse")
    state, active = states(fit)
    stds = [fit.compiled(functions=r).predict(*state, active=active).std for r in (20, 40, 10_000)]
    theirs = fit.predict(*state, active=active).std
    assert theirs is not None and all(std is not None for std in stds)
    lost = [float((std - theirs).max()) for std in stds]  # type: ignore[operator]
    assert lost[0] > lost[1] > lost[2] and lost[2] < 1e-6 * float(theirs.max())


@pytest.mark.slow
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", slow_except(["sparse", "exact", "one_contact"], "one_contact"))
def test_single_precision_errs_by_what_the_export_states(name: str, compiler: str, tmp_path: Path) -> None:
    fit = fitted(name)
    written = fit.export(tmp_path / "c", dtype=torch.float32)
    assert "double" not in (written.folder / "controller.c").read_text()
    assert f"errs by at most {written.rounding[0]:.2g} of" in (written.folder / "README.md").read_text()
    sanitized = ["-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    ran = built(written.folder, *sanitized, compiler=compiler)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    m, flags = fit.training.measurements[0], ["-O1", "-shared", "-fPIC", "-std=c99"]
    command = [compiler, *flags, "controller.c", "-o", "single.so", "-lm"]
    subprocess.run(command, cwd=written.folder, check=True)
    library = ctypes.CDLL(str(written.folder / "single.so"))
    d = 7 + len(fit.system.contacts)
    mean, spread = torch.empty(len(m.q), d), torch.empty(len(m.q), d, d)
    for i in range(len(m.q)):
        state = [x[i].float().contiguous() for x in (m.q, m.qd, m.tau)] + [m.active[i].contiguous()]
        given = [ctypes.c_void_p(x.data_ptr()) for x in (*state, mean[i], spread[i])]
        assert library.controller_predict(*given[:4], 5, 0, *given[4:], None) == 0
    theirs = fit.predict(m.q, m.qd, m.tau, ["qdd", "multiplier"], active=m.active)
    assert theirs.std is not None
    error = ((mean - theirs.mean).abs() / floored(theirs.mean.abs().maximum(theirs.std))).max()
    in_std = (spread.diagonal(dim1=-2, dim2=-1).sqrt() / theirs.std - 1.0).abs()
    seen = theirs.std > ZERO * theirs.std.max()
    for ours, stated in ((error, written.rounding[0]), (in_std[seen].max(), written.rounding[1])):
        assert 1e-8 < float(ours) < 4.0 * stated, "other compilers round differently, but not much worse"


class Bowl(forcegp.constraints.ImplicitSurface):
    """A surface without a C form."""


@pytest.mark.parametrize(
    ("priors", "named"),
    [
        (
            [JointFrictionPrior(), forcegp.priors.PayloadPrior(known=(1.0, 0.0, 0.0, 0.0))],
            "'payload' cannot .* known payload.*PayloadPrior",
        ),
        (
            [forcegp.priors.OperatorForcePrior("wind", 7, lambda s, at: at.eom.M)],
            "'wind' cannot .*Python code",
        ),
    ],
    ids=["payload", "operator"],
)
def test_a_prior_without_a_c_form_is_named(priors: list, named: str, tmp_path: Path) -> None:
    robot = forcegp.load_robot("kuka_iiwa")
    model = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot), "analytical", priors, noise=0.1)
    fit = model.fit(free_log(robot, 12), learn=[])
    with pytest.raises(ModelError, match=r"(?s)force prior " + named):
        fit.export(tmp_path / "c")
    with pytest.raises(ModelError, match=r"(?s)force prior " + named):
        fit.compiled()
    assert not (tmp_path / "c").exists()


def test_names_do_not_become_code() -> None:
    fit = fitted("one_contact")
    robot = fit.system.robot
    names = ("*/ int injected; /*", "a\\", "b\n#error", *robot.joint_names[3:])
    renamed = dataclasses.replace(fit.system.contacts[0], name="*/ int injected; /*")
    system = forcegp.ConstrainedSystem(robot.replace(joint_names=names), [renamed])
    model = fitted("free_friction").compiled().model
    process = model.posterior.process
    priors = tuple(dataclasses.replace(prior, name="*/ int injected; /*") for prior in process.priors)  # type: ignore[type-var]
    posterior = dataclasses.replace(model.posterior, process=dataclasses.replace(process, priors=priors))
    free = dataclasses.replace(model, system=system, posterior=posterior)
    header, source = c_source(free, "arm")
    assert "injected" in header and "injected" in source
    for text in (header, source):
        assert "int injected;" not in text and "\\" not in text.replace("\\\n", "") and "#error" not in text


@pytest.mark.parametrize(("kind", "what"), [(InertialPrior, "the inertia"), (PayloadPrior, "a payload")])
def test_two_priors_on_the_inertia_are_refused(kind: type, what: str) -> None:
    robot = forcegp.load_robot("kuka_iiwa")
    priors = [kind(), kind(name="second")]
    model = forcegp.StructuredGP(forcegp.ConstrainedSystem(robot), "analytical", priors, noise=0.1)
    with pytest.raises(ModelError, match=f"two priors on {what}"):
        model.fit(free_log(robot, 12), learn=[]).compiled()


@pytest.mark.parametrize("kind", ["implicit", "sticking", "connection"])
def test_a_contact_without_a_c_form_is_named(kind: str) -> None:
    robot, tool = forcegp.load_robot("kuka_iiwa"), ("tool", "lbr_iiwa_link_7", (0, 0, 0.1))
    contact = {
        "implicit": lambda: forcegp.SurfaceContact(
            *tool, forcegp.constraints.ImplicitSurface(lambda p: p[2] - 0.1)
        ),
        "sticking": lambda: forcegp.SurfaceContact(*tool, forcegp.Plane(), stick_speed=0.01),
        "connection": lambda: forcegp.constraints.PointConnection(*tool, None, (0.5, 0.0, 0.5)),
    }[kind]()
    data = free_log(robot, 12).replace(contact={"tool": torch.ones(12, dtype=torch.bool)})
    system = forcegp.ConstrainedSystem(robot, [contact])
    fit = forcegp.StructuredGP(system, "analytical", [JointFrictionPrior()], noise=0.1).fit(data, learn=[])
    with pytest.raises(ModelError, match="'tool' cannot be exported"):
        fit.compiled()


def test_what_else_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fit, fast = fitted("one_contact"), compiled("one_contact")
    with pytest.raises(UnknownNameError, match="unknown language of an export 'fortran'"):
        fit.export(tmp_path / "c", language="fortran")
    with pytest.raises(ParameterError, match="'My arm' cannot be the prefix"):
        fit.export(tmp_path / "c", name="My arm")
    with pytest.raises(ModelError, match="at least one function"):
        fit.compiled(functions=0)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "main.c").write_text("")
    with pytest.raises(DestinationError, match="contains other files"):
        fit.export(tmp_path / "mine")
    monkeypatch.setattr("forcegp.models.export.model.LARGEST", 20)
    with pytest.raises(ModelError, match=r"(?s)48 functions is too large.*functions=200"):
        fit.compiled()
    (q, qd, tau), _ = states(fit)
    with pytest.raises(ShapeError, match="qd contains values that are not finite"):
        fast.predict(q, qd * float("nan"), tau)
    with pytest.raises(ShapeError, match="qd contains values that are not finite"):
        fast.predict(q, qd * float("nan"), tau, active=mixed_contacts(len(q))[:, :1])
    with pytest.raises(ShapeError, match="q is not in the precision"):
        fast.predict(q.float(), qd.float(), tau.float())
    with pytest.raises(UnknownNameError, match="unknown quantity 'force'"):
        fast.predict(q, qd, tau, "force")
    with pytest.raises(ModelError, match="its own system"):
        fast.predict(q, qd, tau, system=two_contacts())
    with pytest.raises(ModelError, match="save the fit"):
        fast.save(tmp_path / "model")


def test_the_c_code_reports_a_state_that_is_not_finite() -> None:
    fast = compiled("one_contact")
    q, qd, tau = (torch.zeros(7, dtype=torch.float64) for _ in range(3))
    mean = torch.full((7,), 5.0, dtype=torch.float64)

    def status() -> int:
        pointers = [ctypes.c_void_p(x.data_ptr()) for x in (q, qd, tau)]
        out = ctypes.c_void_p(mean.data_ptr())
        return fast.library.forcegp_predict(*pointers, None, ctypes.c_uint(1), 0, out, None, None)

    assert status() == 0 and not bool((mean == 5.0).any())
    mean[:], qd[4] = 5.0, float("inf")
    assert status() == 1 and bool((mean == 5.0).all())


CHECK = """
#include "controller.c"
int check(const double *covariance, int n) { return semidefinite(covariance, n); }
"""


@pytest.mark.slow
@needs_gcc
def test_the_c_code_finds_negative_eigenvalues(tmp_path: Path) -> None:
    """The check of `Prediction`, on covariances of variables of very different sizes."""
    folder = fitted("one_contact").export(tmp_path / "c").folder
    (folder / "check.c").write_text(CHECK)
    command = ["gcc", "-std=c99", "-O1", "-shared", "-fPIC", "check.c", "-o", "check.so", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    check, random = ctypes.CDLL(str(folder / "check.so")).check, torch.Generator().manual_seed(3)
    verdicts = []
    for k in range(200):
        basis = torch.linalg.qr(torch.randn(8, 8, dtype=torch.float64, generator=random)).Q
        values = torch.rand(8, dtype=torch.float64, generator=random)
        values[0] = (0.0, 1e-3, -1e-5, -0.1)[k % 4]
        size = 10.0 ** torch.randint(-4, 4, (8,), generator=random).double()
        covariance = (basis * values @ basis.mT) * size[:, None] * size
        covariance = 0.5 * (covariance + covariance.mT)
        try:
            Prediction(torch.zeros(8, dtype=torch.float64), covariance)
            sound = True
        except NumericalError:
            sound = False
        assert bool(check(ctypes.c_void_p(covariance.data_ptr()), 8)) == sound
        verdicts.append(sound)
    assert all(verdicts[0::4] + verdicts[1::4] + verdicts[2::4]) and not all(verdicts[3::4])
    assert sum(verdicts[3::4]) < 5


@pytest.mark.slow
def test_a_contact_that_jams_is_an_error_in_both() -> None:
    prior = SlidingFrictionPrior("table", terms=("coulomb",), friction_coefficient=0.0)
    model = forcegp.StructuredGP(two_contacts(), "analytical", [JointFrictionPrior(), prior], noise=0.1)
    fit = model.fit(logged(two_contacts(), 14), learn=[])
    jammed = SlidingFrictionPrior("table", terms=("coulomb",), friction_coefficient=50.0)
    process = fit.posterior.process
    object.__setattr__(process, "priors", (process.priors[0], jammed))
    state, _ = states(fit)
    for predictor in (fit, fit.compiled()):
        with pytest.raises(ModelError, match="jams"):
            predictor.predict(*state)


@pytest.mark.slow
@needs_gcc
def test_the_command(tmp_path: Path) -> None:
    fitted("one_contact").save(tmp_path / "model")
    arguments = [
        "export",
        "--model",
        str(tmp_path / "model"),
        "--to",
        "c",
        "--out",
        str(tmp_path / "c"),
        "--json",
    ]
    done = CliRunner().invoke(app, [*arguments, "--functions", "40"])
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    assert result["functions"] == 40 and 0.0 <= result["wider"] <= result["widest"]
    assert built(tmp_path / "c", "-O1").returncode == 0
    nominal = forcegp.AnalyticalModel(two_contacts()).nominal()
    nominal.save(tmp_path / "file")
    arguments[2] = str(tmp_path / "file")
    arguments[arguments.index("--out") + 1] = str(tmp_path / "other")
    done = CliRunner().invoke(app, arguments)
    assert isinstance(done.exception, ForceGPError)
    assert "only a structured Gaussian process can be exported" in str(done.exception)
