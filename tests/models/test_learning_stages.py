"""What is learned and what is held, in one fit and from one fit to the next."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import forcegp
from forcegp.forces.priors.contact import ContactForcePrior, NormalForcePrior
from forcegp.forces.priors.joint import JointForcePrior
from forcegp.models import LearningOptions
from forcegp.models.structured_fit import StructuredFit
from forcegp.priors import Observation
from forces.cases import draw, logged, mixed_contacts, two_contacts

SHORT = LearningOptions(max_evaluations=3)
data = logged(two_contacts(), 12)


def theta() -> forcegp.robot.AnalyticalParameters:
    robot = two_contacts().robot
    return forcegp.robot.AnalyticalParameters(robot, {"mass": robot.joint_names[-2:]})


def model(**settings: object) -> forcegp.StructuredGP:
    return forcegp.StructuredGP(
        two_contacts(),
        "analytical",
        [JointForcePrior(), ContactForcePrior("table")],
        noise=0.1,
        **settings,  # type: ignore[arg-type]
    )


def test_analytical_parameters_are_learned_alone_and_frozen_later() -> None:
    one = model(analytical_parameters=theta())
    first = one.fit(data, learn=["analytical_parameters"], options=SHORT)
    mass = first.system.robot.mass
    assert not torch.equal(mass, two_contacts().robot.mass)
    second = one.fit(data, learn=["joint", "contact_table"], after=first, options=SHORT)
    assert torch.equal(second.system.robot.mass, mass), "held at what the first stage learned"
    assert not torch.equal(second.hyperparameters["joint.log_std"], first.hyperparameters["joint.log_std"])


def test_nothing_to_learn_conditions_only() -> None:
    fit = model(analytical_parameters=theta()).fit(data, learn=[])
    assert fit.result.evaluations == 0 and fit.result.message == "conditioned, nothing learned"
    torch.testing.assert_close(fit.system.robot.mass, two_contacts().robot.mass)


def test_a_loaded_model_goes_on_learning_analytical_parameters(tmp_path: Path) -> None:
    one = model(analytical_parameters=theta())
    first = one.fit(data, learn=["analytical_parameters"], options=SHORT)
    mass = first.system.robot.mass
    first.save(tmp_path / "model")
    read = forcegp.load_model(tmp_path / "model")
    assert isinstance(read, StructuredFit)
    assert torch.equal(read.system.robot.mass, mass)
    options = LearningOptions(max_evaluations=10)
    again = one.fit(data, learn=["analytical_parameters"], after=read, options=options)
    assert not torch.equal(again.system.robot.mass, mass)


@pytest.mark.parametrize("learn", [[], ["joint"]])
def test_a_later_stage_has_the_noise_of_its_own_model(learn: list[str]) -> None:
    first = model().fit(data, learn=[])
    noisier = forcegp.StructuredGP(two_contacts(), "analytical", first.force_priors, noise=0.5)
    second = noisier.fit(data, learn=learn, after=first, options=SHORT)
    assert float(second.training.noise_std[0].min()) == 0.5
    assert float(first.training.noise_std[0].max()) == 0.1


def test_a_fit_stays_as_it_is() -> None:
    """A fitted object does not change when the model is fitted again."""
    one = model()
    first = one.fit(data, learn=[])
    q, qd, tau = draw(3)
    before = first.predict(q, qd, tau, active=mixed_contacts(3)).mean
    other = one.fit(data[:6], options=SHORT)
    assert torch.equal(first.predict(q, qd, tau, active=mixed_contacts(3)).mean, before)
    assert not torch.equal(other.predict(q, qd, tau, active=mixed_contacts(3)).mean, before)
    with pytest.raises(AttributeError):
        first.system = two_contacts()  # type: ignore[misc]


def test_the_normal_force_is_no_contact_friction() -> None:
    joint = JointForcePrior()
    bare = forcegp.StructuredGP(two_contacts(), "analytical", [joint, ContactForcePrior("table")], 0.1)
    normal = forcegp.StructuredGP(
        two_contacts(), "analytical", [joint, NormalForcePrior(joint), ContactForcePrior("table")], 0.1
    )
    q, qd, tau = draw(4, seed=5)
    read, fits = {}, {"bare": bare.fit(data, learn=[]), "normal": normal.fit(data, learn=[])}
    for name, one in fits.items():
        read[name] = {
            quantity: one.predict(q, qd, tau, quantity, active=mixed_contacts(4)).covariance
            for quantity in ("contact_friction", "qdd", "multiplier")
        }
    for quantity in ("contact_friction", "qdd"):
        torch.testing.assert_close(read["bare"][quantity], read["normal"][quantity])
    assert bool((read["normal"]["multiplier"][0] > read["bare"]["multiplier"][0]).any())
    assert fits["normal"].result.force_correlation == pytest.approx(
        fits["bare"].result.force_correlation, abs=1e-9
    )


def test_the_correlation_does_not_depend_on_the_order_of_observations() -> None:
    free = data[(~data.active(two_contacts().contact_names).any(-1)).nonzero()[:, 0]]
    closed = data[data.active(two_contacts().contact_names)[:, 0].nonzero()[:, 0]]
    one, two = model(), model()
    a = one.fit([Observation(free), Observation(closed)], learn=[])
    b = two.fit([Observation(closed), Observation(free)], learn=[])
    assert a.result.force_correlation is not None and a.result.force_correlation != 0.0
    assert a.result.force_correlation == pytest.approx(b.result.force_correlation, rel=1e-8)


def test_an_undetermined_multiplier_is_a_warning() -> None:
    """Free joint forces of any size along the normal leave the multiplier open."""
    closed = data[data.active(two_contacts().contact_names)[:, 0].nonzero()[:, 0]]
    wide = {"joint.log_std": torch.full((7,), 8.0, dtype=torch.float64)}
    one = forcegp.StructuredGP(two_contacts(), "analytical", [JointForcePrior()], noise=1.0)
    quiet = one.fit(closed, learn=[])
    assert not any("multiplier" in warning for warning in quiet.result.warnings)
    loud = quiet.condition(closed, {**quiet.hyperparameters, **wide})
    assert any("multiplier is not determined" in warning for warning in loud.result.warnings)
