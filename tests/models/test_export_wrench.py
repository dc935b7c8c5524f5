"""The external wrench in C: that of `external_wrench`, its Jacobian, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

import forcegp
from forcegp.data.fields import DataHeader
from forcegp.errors import ModelError, ShapeError, UnknownNameError
from forcegp.models.external_wrench import ExternalWrench
from forcegp.models.structured_fit import StructuredFit
from models.test_export import COMPILERS, SAME, built, differences, fitted, states
from models.test_export_slopes import difference
from slow import slow_except

TOOL = forcegp.WrenchFrame("lbr_iiwa_link_7", point=(0.0, 0.02, 0.1))
ELBOW = forcegp.WrenchFrame("lbr_iiwa_link_5", "local", ("fx", "mz"), prior_std=(20.0, 2.0))
ROUGH = 1e-5
"""Of differences with two step lengths, in units of the largest entry: rounding over a step of 3e-5."""


def log_of(fit: StructuredFit) -> tuple[forcegp.Dataset, Tensor]:
    """Samples in any order, with noise of accelerations and closed contacts."""
    (q, qd, tau), active = states(fit)
    qdd = fit.predict(q, qd, tau, active=active, covariance=False).mean
    qdd = qdd + 0.1 * torch.randn(qdd.shape, dtype=qdd.dtype, generator=torch.Generator().manual_seed(4))
    closed = {name: active[:, i] for i, name in enumerate(fit.system.contact_names)}
    t, joints = torch.arange(len(q), dtype=q.dtype), fit.system.robot.joint_names
    header = DataHeader(ordered=False)
    return forcegp.Dataset(t, q, qd, tau, qdd, joints, contact=closed, header=header), active


def in_python(fit: StructuredFit, data: forcegp.Dataset, frame: forcegp.WrenchFrame) -> ExternalWrench:
    components = {x: getattr(frame, x) for x in ("reference", "axes", "point", "prior_std")}
    return fit.external_wrench(data, frame.frame, **components)


def rounding(fit: StructuredFit, data: forcegp.Dataset, frame: forcegp.WrenchFrame) -> float:
    """`SAME`, or, where M q̈ − Q̄ cancels most digits, four times the change by one bit of each number."""
    bits = {
        x: torch.nextafter(getattr(data, x), torch.full_like(data.q, 9e9)) for x in ("q", "qd", "tau", "qdd")
    }
    pair = in_python(fit, data.replace(**bits), frame), in_python(fit, data, frame)
    return max(SAME, 4.0 * max(differences(*pair)))


CASES = ["free_friction", "free_inertial", "uncertain_inertia", "one_contact", "sparse", "exact", "zero_mean"]


@pytest.mark.parametrize("frame", [TOOL, pytest.param(ELBOW, marks=pytest.mark.slow)], ids=["world", "local"])
@pytest.mark.parametrize("name", slow_except(CASES, "one_contact"))
def test_the_wrench_of_the_fit_and_its_jacobian(name: str, frame: forcegp.WrenchFrame) -> None:
    fit, fast = fitted(name), fitted(name).compiled(wrench=frame)
    data, active = log_of(fit)
    theirs, at = in_python(fit, data, frame), (data.q, data.qd, data.tau, data.qdd)
    ours = fast.external_wrench(*at, active=active)
    same = rounding(fit, data, frame)
    assert max(differences(ours, theirs)) < same < 1e-8
    assert ours.frame == frame and ours.parts == theirs.parts
    assert torch.equal(ours.detect(), theirs.detect())
    if theirs.beyond is not None and ours.beyond is not None:
        torch.testing.assert_close(ours.beyond, theirs.beyond, rtol=1e-12, atol=0.0)
    stated = data.replace(extras={"qdd_std": torch.full_like(data.q, 0.7)})
    noisy = fast.external_wrench(*at, active=active, qdd_std=torch.full((7,), 0.7, dtype=torch.float64))
    assert max(differences(noisy, in_python(fit, stated, frame))) < same
    assert max(differences(noisy, theirs)) > 1e3 * SAME
    found = fast.wrench_jacobian(*at, active=active)
    assert torch.equal(found.mean, ours.mean)
    for field, slopes in zip(("q", "qd", "tau", "qdd"), found[1:], strict=True):
        columns, step = [], 3e-5 if field in ("q", "qd") else 3e-4
        for unit in torch.eye(7, dtype=torch.float64) * step:
            near = [data.replace(**{field: getattr(data, field) + k * unit}) for k in (-2.0, -1.0, 1.0, 2.0)]
            a, b, c, d = (in_python(fit, x, frame).mean for x in near)
            columns.append((8.0 * (c - b) - (d - a)) / (12.0 * step))
        assert difference(slopes, torch.stack(columns, dim=-1)) < ROUGH, field


def test_it_learns_online() -> None:
    fit = fitted("one_contact")
    data, active = log_of(fit)
    at, single = (data.q, data.qd, data.tau, data.qdd), fit
    for i in range(6):
        single = single.update(data[i : i + 1])
    fast = fit.compiled(wrench=TOOL)
    newer = fast.update(*(x[:6] for x in at), active=active[:6])
    ours, theirs = newer.external_wrench(*at, active=active), in_python(single, data, TOOL)
    assert max(differences(ours, theirs)) < SAME
    assert max(differences(fast.external_wrench(*at, active=active), theirs)) > 1e3 * SAME


@pytest.mark.slow
@pytest.mark.parametrize("compiler", COMPILERS)
def test_its_code_compiles_without_warnings_and_sanitizers_find_nothing(
    compiler: str, tmp_path: Path
) -> None:
    folder = fitted("one_contact").export(tmp_path / "c", wrench=TOOL).folder
    assert "wrench_covariance" in (folder / "test_controller.c").read_text()
    flags = ["-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    ran = built(folder, *flags, compiler=compiler)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    text = (folder / "test_controller.c").read_text()
    line = next(line for line in text.splitlines() if line.startswith("static const double wrench["))
    first = line.partition("{{")[2].partition(",")[0]
    wrong = repr(float(first) * 1.001)
    (folder / "test_controller.c").write_text(text.replace(line, line.replace(first, wrong)))
    assert built(folder, "-O0").returncode == 1, "a wrong wrench is not found"


@pytest.mark.slow
def test_what_is_refused() -> None:
    fit = fitted("one_contact")
    data, _ = log_of(fit)
    at = [data.q, data.qd, data.tau, data.qdd]
    with pytest.raises(UnknownNameError, match="unknown frame of robot 'kuka_iiwa' 'hand'"):
        fit.compiled(wrench=forcegp.WrenchFrame("hand"))
    with pytest.raises(ModelError, match="without an external wrench"):
        fit.compiled().external_wrench(*at)
    with pytest.raises(ModelError, match="an external wrench needs double precision"):
        fit.export("unused", wrench=TOOL, dtype=torch.float32)
    fast = fit.compiled(wrench=TOOL)
    for i, name in enumerate(("q", "qd", "tau", "qdd")):
        wrong = [x * float("nan") if k == i else x for k, x in enumerate(at)]
        with pytest.raises(ShapeError, match=f"{name} contains values that are not finite"):
            fast.external_wrench(*wrong)
    with pytest.raises(ShapeError, match="qdd"):
        fast.external_wrench(*at[:3], data.qdd[:, :3])
