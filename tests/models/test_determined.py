"""What motion does not determine is NaN under a mask, never a zero; misfits and idle options are said."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

import forcegp
from forcegp.cli import app
from forcegp.constraints import PointConnection, SurfaceContact
from forcegp.constraints.contact import Constraint
from forcegp.data import RobotMismatchWarning
from forcegp.errors import ModelError, NumericalError
from forcegp.evaluation.predicted import multiplier_scores
from forcegp.forces.priors.sets import contact_priors, friction_priors
from forcegp.models import Inference
from forcegp.models.prediction import Prediction
from forcegp.models.structured_fit import StructuredFit
from forcegp.simulate import simulate

SCENE = forcegp.load_scene("kuka_plane")
SYSTEM = SCENE.system()
TABLE = SYSTEM.contacts[0]


@pytest.fixture(scope="module")
def data() -> forcegp.Dataset:
    """Some samples of the bundled scene's motion in contact."""
    return simulate(SYSTEM, replace(SCENE.simulation, duration=6.0)).data[::20]


def closed_on(data: forcegp.Dataset, names: list[str], closed: bool = True) -> forcegp.Dataset:
    """The samples with contacts of these names, all of them closed or open."""
    state = torch.full((len(data),), closed)
    header = data.header.model_copy(update={"contact_names": tuple(names)})
    return data.replace(contact=dict.fromkeys(names, state), contact_extras={}, header=header)


def with_contacts(*contacts: Constraint) -> forcegp.ConstrainedSystem:
    """The robot of the scene with other contacts."""
    return forcegp.ConstrainedSystem(SYSTEM.robot, contacts, SYSTEM.baumgarte)


def fitted(system: forcegp.ConstrainedSystem, data: forcegp.Dataset) -> StructuredFit:
    priors = [forcegp.priors.JointFrictionPrior()]
    return forcegp.StructuredGP(system, "analytical", priors, noise=0.1).fit(data, learn=[])


@pytest.mark.parametrize(
    "held",
    [
        SurfaceContact("held", "lbr_iiwa_link_0", (0.0, 0.0, 0.0), forcegp.Plane()),
        SurfaceContact("held", "lbr_iiwa_link_1", (0.0, 0.0, 0.1), forcegp.Plane(normal=(1.0, 0.0, 0.0))),
        PointConnection("held", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), "lbr_iiwa_link_7", (0.0, 0.0, 0.1)),
    ],
    ids=["base", "axis", "loop"],
)
def test_a_point_that_cannot_move_has_no_force(data: forcegp.Dataset, held: SurfaceContact) -> None:
    system, log = with_contacts(TABLE, held), closed_on(data, ["table", "held"])
    fit, states = fitted(system, log), (log.q, log.qd, log.tau)
    plain = fitted(SYSTEM, closed_on(data, ["table"])).predict(*states, "multiplier")
    for model in (fit, forcegp.AnalyticalModel(system).nominal()):
        found = model.predict(*states, "multiplier")
        assert found.determined is not None and found.mean[:, 1:].isnan().all()
        assert (found.determined == torch.tensor([True] + [False] * held.rows)).all()
        assert any("contact held cannot move" in doubt for doubt in found.warnings)
    found = fit.predict(*states, "multiplier")
    assert any("contact held cannot move" in doubt for doubt in fit.result.warnings)
    torch.testing.assert_close(found.mean[:, :1], plain.mean)
    torch.testing.assert_close(found.std[:, :1], plain.std)  # type: ignore[index, arg-type]
    assert found.std[:, 1:].isnan().all()  # type: ignore[index]
    assert fit.predict(*states, "constraint_force").determined is None


def test_of_contacts_at_one_place_only_the_sum_is_determined(data: forcegp.Dataset) -> None:
    names = ["a", "b", "c"]
    system = with_contacts(*(replace(TABLE, name=name) for name in names))  # type: ignore[type-var]
    log = closed_on(data, names)
    fit, states = fitted(system, log), (log.q, log.qd, log.tau)
    one = fitted(SYSTEM, closed_on(data, ["table"])).predict(*states, "multiplier")
    for quantity, rows in (("multiplier", slice(0, 3)), ("contact_force", slice(2, 9, 3))):
        found = fit.predict(*states, ["qdd", quantity])
        part = slice(found.parts[quantity].start, None)
        mean, covariance = found.mean[:, part][:, rows], found.covariance[:, part, part][:, rows, rows]  # type: ignore[index]
        torch.testing.assert_close(mean.sum(-1), one.mean[:, 0])
        # Each may carry nothing, or all.
        assert (covariance.diagonal(dim1=1, dim2=2).sqrt() > 0.4 * mean.sum(-1, keepdim=True)).all()
        torch.testing.assert_close(covariance.sum((1, 2)), one.variance[:, 0], atol=1e-9, rtol=1e-6)  # type: ignore[index]
        assert found.determined is not None and found.determined.all()
    for said in (found.warnings, fit.result.warnings):
        assert any("contacts a, b, c" in text and "only the sum" in text for text in said)


def test_a_contact_that_was_never_closed_has_no_force(data: forcegp.Dataset, tmp_path: Path) -> None:
    never, states = closed_on(data, ["table"], closed=False), (data.q, data.qd, data.tau)
    fit = fitted(SYSTEM, never)
    assert any("never closed in the training data" in text for text in fit.result.warnings)
    fit.save(tmp_path / "model")
    for model in (fit, forcegp.load_model(tmp_path / "model")):
        for quantity in ("multiplier", "contact_force", "constraint_force"):
            for active in (None, torch.zeros(len(data), 1, dtype=torch.bool)):
                with pytest.raises(ModelError, match="table is never closed in the training data"):
                    model.predict(*states, quantity, active=active)
    found = fit.predict(*states, ["qdd", "multiplier"])
    assert found.mean[:, 7:].isnan().all() and found.mean[:, :7].isfinite().all()
    assert (found.determined == torch.tensor([True] * 7 + [False])).all()  # type: ignore[union-attr]
    # The forces that were learned may be read on any system that the caller states.
    assert fit.predict(*states, "multiplier", system=SYSTEM).determined is None
    assert multiplier_scores(fit, data) == ()
    never.write(tmp_path / "log.parquet")
    command = ["predict", "-m", str(tmp_path / "model.safetensors"), "-d", str(tmp_path / "log.parquet")]
    done = CliRunner().invoke(app, [*command, "-q", "multiplier", "-o", str(tmp_path / "p.parquet")])
    assert done.exit_code != 0 and isinstance(done.exception, ModelError)


def test_a_contact_that_an_update_closes_has_a_force(data: forcegp.Dataset) -> None:
    never, states = closed_on(data, ["table"], closed=False), (data.q, data.qd, data.tau)
    fit = forcegp.StructuredGP(
        SYSTEM, "analytical", friction_priors(SYSTEM), noise=0.1, inference="sparse"
    ).fit(never, learn=[])
    assert fit.update(never[:4]).result.never_closed == ("table",)
    fit = fit.update(data)
    assert fit.result.never_closed == () and fit.predict(*states, "multiplier").mean.isfinite().all()


def test_an_open_contact_of_a_model_that_knows_it_closed_carries_no_force(data: forcegp.Dataset) -> None:
    fit = fitted(SYSTEM, data)
    open_ = torch.zeros(len(data), 1, dtype=torch.bool)
    found = fit.predict(data.q, data.qd, data.tau, "multiplier", active=open_)
    assert found.determined is None and not found.mean.any() and not found.std.any()  # type: ignore[union-attr]


def test_the_command_line_writes_what_is_not_determined_as_nan(data: forcegp.Dataset, tmp_path: Path) -> None:
    held = SurfaceContact("held", "lbr_iiwa_link_0", (0.0, 0.0, 0.0), forcegp.Plane())
    system, log = with_contacts(TABLE, held), closed_on(data, ["table", "held"])
    fitted(system, log).save(tmp_path / "model")
    log.write(tmp_path / "log.parquet")
    command = ["predict", "-m", str(tmp_path / "model.safetensors"), "-d", str(tmp_path / "log.parquet")]
    done = CliRunner().invoke(app, [*command, "-q", "multiplier", "-o", str(tmp_path / "p.parquet")])
    assert done.exit_code == 0 and "contact held cannot move" in done.output, done.output
    written = forcegp.Dataset.read(tmp_path / "p.parquet").contact_extras
    for name in ("predicted_multiplier", "predicted_multiplier_std"):
        assert written[name]["held"].isnan().all() and written[name]["table"].isfinite().all()


def test_nan_stands_under_the_mask_only() -> None:
    mean = torch.tensor([[1.0, torch.nan]])
    assert Prediction(mean, determined=torch.tensor([[True, False]])).mean.isnan().any()
    for mask in (None, torch.tensor([[False, True]])):
        with pytest.raises(NumericalError, match="the mean of a prediction is not finite"):
            Prediction(mean, determined=mask)


def doubts_of(data: forcegp.Dataset, **settings: object) -> str:
    """Warnings of a fit of the scene."""
    model = forcegp.StructuredGP(SYSTEM, **{"mean": "analytical", "noise": 0.1, **settings})  # type: ignore[arg-type]
    return " | ".join(model.fit(data, learn=[]).result.warnings)


@pytest.mark.parametrize("inference", ["exact", "sparse"])
def test_a_model_that_misses_its_data_by_far_says_by_how_much(data: forcegp.Dataset, inference: str) -> None:
    settings = {"force_priors": contact_priors(SYSTEM), "inference": inference}
    assert "misses" not in doubts_of(data, **settings)
    # Two newton metres at one joint that nothing in the model explains.
    pushed = data.replace(tau=data.tau + 2.0 * torch.eye(7, dtype=torch.float64)[1])
    found = re.search(
        r"fits its training data poorly: residuals are ([\d.]+) times", doubts_of(pushed, **settings)
    )
    assert found is not None and float(found[1]) > 3.0


def test_options_without_effect_are_said(data: forcegp.Dataset) -> None:
    joint = [forcegp.priors.JointForcePrior()]
    assert 'inertia="auto" has no effect' in doubts_of(data, force_priors=joint, inertia="auto")
    exact = {"force_priors": joint, "inference": "exact"}
    many = {"force_priors": joint, "inference": Inference("exact", inducing_points=50)}
    assert "inducing_points=50 has no effect: the fit has exact" in doubts_of(data, **many)
    friction = [forcegp.priors.JointFrictionPrior()]
    finite = {"force_priors": friction, "inference": Inference("sparse", inducing_points=50)}
    assert "priors with finitely many features" in doubts_of(data, **finite)
    used = {"force_priors": joint, "inference": Inference("sparse", inducing_points=20)}
    for settings in (exact, used, {"force_priors": friction_priors(SYSTEM), "inertia": "auto"}):
        assert "no effect" not in doubts_of(data, **settings)


def test_planes_that_cannot_both_be_touched_and_angles_in_degrees_are_said(data: forcegp.Dataset) -> None:
    upper = replace(TABLE, name="upper", surface=forcegp.Plane(offset=0.255))  # type: ignore[type-var]
    log = closed_on(data, ["table", "upper"])
    said = fitted(with_contacts(TABLE, upper), log).result.warnings
    assert any("contact upper is closed up to 200 mm off its surface" in text for text in said)
    assert not any("table is closed up to" in text for text in said)
    degrees = data.replace(q=data.q * 57.29577951308232)
    with pytest.warns(RobotMismatchWarning, match="logged in degrees"):
        fitted(SYSTEM, degrees)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RobotMismatchWarning)
        fitted(SYSTEM, data)


def test_an_arm_that_contacts_hold_at_every_joint_is_a_typed_error() -> None:
    robot = forcegp.load_robot("double_pendulum")
    q = torch.tensor([0.4, 0.8], dtype=torch.float64)
    R, p = forcegp.kinematics.frame_pose(robot, q, robot.frame_names[-1])
    grip = (0.0, 0.0, 0.3)
    pin = PointConnection("pin", robot.frame_names[-1], grip, None, (R @ q.new_tensor(grip) + p).tolist())
    n = 30
    noise = torch.randn(2, n, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    held = forcegp.Dataset(
        t=0.01 * torch.arange(n, dtype=torch.float64),
        q=q.expand(n, 2),
        qd=torch.zeros(n, 2, dtype=torch.float64),
        tau=noise[0],
        qdd=1e-3 * noise[1],
        joint_names=robot.joint_names,
        contact={"pin": torch.ones(n, dtype=torch.bool)},
    )
    system = forcegp.ConstrainedSystem(robot, (pin,))
    with pytest.raises(ModelError, match="contacts that hold all joints"):
        forcegp.StructuredGP(system, "analytical", friction_priors(system)).fit(held)
