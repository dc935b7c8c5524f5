"""The forces of contacts from accelerations in C: those of `contact_force`, for an arm and a quadruped."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import pytest
import torch

import forcegp
from forcegp.data.fields import DataHeader
from forcegp.errors import ModelError, ShapeError
from forcegp.models.export.library import CompiledFit
from forcegp.models.prediction import Prediction
from forcegp.models.structured_fit import StructuredFit
from models.test_export import SAME, built, compiled, fitted, needs_gcc
from models.test_export_wrench import log_of
from slow import slow_except

LEAST = 1e-9
"""Below the standard deviation of any force of a closed contact [N]."""


def apart(ours: Prediction, theirs: Prediction) -> float:
    """Largest difference of means over max(|mean|, σ), and of covariances over σ_i σ_j."""
    assert ours.covariance is not None and theirs.covariance is not None and theirs.std is not None
    std = theirs.std.clamp(min=LEAST)
    mean = (ours.mean - theirs.mean).abs() / std.maximum(theirs.mean.abs())
    covariance = (ours.covariance - theirs.covariance).abs() / (std[..., None] * std[..., None, :])
    return max(float(mean.max()), float(covariance.max()))


def compare(fit: StructuredFit, data: forcegp.Dataset, fast: CompiledFit) -> float:
    """Largest difference in units of max(|mean|, σ), after comparing the other fields."""
    theirs, active = fit.contact_force(data), data.active(fit.system.contact_names)
    ours = fast.contact_force(data.q, data.qd, data.tau, data.qdd, active=active)
    assert ours.parts == theirs.parts and ours.joint_names == theirs.joint_names
    assert ours.covariance is not None
    open_ = ~active.repeat_interleave(3, dim=-1)
    assert not bool(ours.mean[open_].any()) and not bool(ours.covariance[open_].any())
    if theirs.beyond is not None and ours.beyond is not None:
        torch.testing.assert_close(ours.beyond, theirs.beyond, rtol=1e-12, atol=0.0)
    return apart(ours, theirs)


CASES = ["one_contact", "sparse", "exact", "every_friction", "rounded_tip"]


@pytest.mark.parametrize("name", slow_except(CASES, "one_contact"))
def test_the_forces_of_the_fit(name: str) -> None:
    fit, fast = fitted(name), compiled(name)
    data, active = log_of(fit)
    assert compare(fit, data, fast) < SAME
    stated = data.replace(extras={"qdd_std": torch.full_like(data.q, 0.7)})
    std = torch.full((7,), 0.7, dtype=torch.float64)
    noisy = fast.contact_force(data.q, data.qd, data.tau, data.qdd, active=active, qdd_std=std)
    assert apart(noisy, fit.contact_force(stated)) < SAME
    assert apart(noisy, fit.contact_force(data)) > 1e3 * SAME


def test_it_learns_online() -> None:
    fit, single = fitted("one_contact"), fitted("one_contact")
    data, active = log_of(fit)
    at = (data.q, data.qd, data.tau, data.qdd)
    for i in range(6):
        single = single.update(data[i : i + 1])
    newer = compiled("one_contact").update(*(x[:6] for x in at), active=active[:6])
    assert compare(single, data, newer) < 1e-8
    assert compare(single, data, compiled("one_contact")) > 1e-4


def test_what_is_refused() -> None:
    free = compiled("free_friction")
    x = torch.zeros(7, dtype=torch.float64)
    with pytest.raises(ModelError, match="no contact with a surface"):
        free.contact_force(x, x, x, x)
    with pytest.raises(ShapeError, match="qdd contains values that are not finite"):
        compiled("one_contact").contact_force(x, x, x, x * float("nan"))
    plain = fitted("free_friction").compiled(jacobians=False, online=False)
    with pytest.raises(ModelError, match="cannot learn online"):
        plain.update(x, x, x, x)
    with pytest.raises(ModelError, match="without Jacobians"):
        plain.linearize(x, x, x)
    ours, theirs = plain.predict(x, x, x), free.predict(x, x, x)
    torch.testing.assert_close(ours.mean, theirs.mean)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["free_inertial", "uncertain_inertia"])
def test_errors_of_base_parameters_are_fewer_and_have_the_same_effect(name: str) -> None:
    fit = fitted(name)
    fast, (data, active) = fit.compiled(online=False), log_of(fit)
    functions = [
        sum(part.components for part in parts) for parts in (fast.model.parts(), fast.model.parts_of_motion())
    ]
    assert functions[0] - functions[1] >= 20  # of 70 parameters of links, at most 48 affect the motion
    state = data.q, data.qd, data.tau
    assert apart(fast.predict(*state, active=active), fit.predict(*state, active=active)) < SAME
    for ours, theirs in zip(
        fast.linearize(*state, active=active), fit.linearize(*state, active=active), strict=True
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-8, atol=1e-8)


@needs_gcc
@pytest.mark.slow
@pytest.mark.parametrize("jacobians", [True, False])
def test_its_code_compiles_without_warnings_and_sanitizers_find_nothing(
    jacobians: bool, tmp_path: Path
) -> None:
    folder = fitted("one_contact").export(tmp_path / "c", jacobians=jacobians).folder
    assert ("_jacobian(" in (folder / "controller.h").read_text()) == jacobians
    flags = ["-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    ran = built(folder, *flags)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    test = folder / "test_controller.c"
    before, name, table = test.read_text().partition("double contact_force[")
    force = next(x for x in re.findall(r"-?\d+\.[-\de.]+", table) if float(x) != 0.0)
    test.write_text(before + name + table.replace(force, repr(float(force) * 1.001), 1))
    assert built(folder, "-O0").returncode == 1, "a wrong force is not found"


@pytest.mark.slow
def test_four_feet_of_a_walking_robot() -> None:
    from models import test_legs

    pytest.importorskip("mujoco")
    fit, (_, _, test, _) = test_legs.fitted(), test_legs.walking()
    fast, names = fit.compiled(jacobians=False, online=False), fit.system.contact_names
    data = test[::20].replace(header=DataHeader(ordered=False))
    assert compare(fit, data, fast) < SAME
    for feet in itertools.product((False, True), repeat=4):
        closed = {x: torch.full((len(data),), shut) for x, shut in zip(names, feet, strict=True)}
        if any(feet):
            assert compare(fit, data.replace(contact=closed), fast) < SAME, feet
