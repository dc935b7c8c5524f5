"""What the guide `docs/howto/log_to_model.md` prints about the wiping UR5, beside the simulator's truth.

Statements that are false today belong to what is learned from a log, and are expected to fail.
"""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

import forcegp
from forcegp.cli import app
from forcegp.models.structured_fit import StructuredFit
from statements.stated import friction_of
from statements.wiping import CSV, DRY, FOLDER, SCENE, VISCOUS, log, system

SIGMAS = 4.0
"""Largest accepted error of a printed value in its printed standard deviations: 12 values, and rounding."""


WRIST = 0.4
"""Viscosity [N m s/rad] of the dry friction of the last wrist in MuJoCo, M b d/(1 − d) with M = 0.42 g m²,
b = 105/s and the default impedance d = 0.9. It reaches 0.6 N m at 1.5 rad/s, and the wrist is slower."""


def run(*arguments: object) -> str:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, (done.output, done.exception)
    return done.output


@pytest.fixture(scope="module")
def guide(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of the guide after the fit, and what the fit printed."""
    folder = tmp_path_factory.mktemp("guide")
    mapping, parquet = FOLDER / "ur5_wiping.mapping.toml", folder / "log.parquet"
    run("import", CSV, "--scene", SCENE, "--mapping", mapping, "--out", parquet)
    train, test = folder / "train.parquet", folder / "test.parquet"
    split = "--split", "stretches", "--stretch", 2, "--method", "random"
    run("select", parquet, "-n", 1200, *split, "--out", train, "--rest", test)
    return folder, run("fit", "--scene", SCENE, "--data", train, "--out", folder / "model")


def test_the_wrists_have_their_inertia(guide: tuple[Path, str]) -> None:
    fit = forcegp.load_model(guide[0] / "model")
    q = log()[0].q[::100]
    found, true = (
        forcegp.dynamics.mass_matrix(robot, q).diagonal(dim1=-2, dim2=-1).mean(0)
        for robot in (fit.system.robot, system().robot)
    )
    assert bool((found / true < 1.5).all()) and bool((found / true > 0.67).all()), (found / true).tolist()


def test_no_drives_are_printed_where_there_are_none(guide: tuple[Path, str]) -> None:
    joints = "|".join(system().robot.joint_names)
    assert not re.search(rf"drives? .*(?:{joints}) [\d.]+", guide[1])


@cache
def stated() -> dict[tuple[str, str], tuple[float, float]]:
    return friction_of(forcegp.check(system(), log()[0]), system().robot.joint_names)


def test_friction_that_check_prints_lies_within_its_bars() -> None:
    names = system().robot.joint_names
    truth = {(name, "N m"): x for name, x in zip(names, DRY, strict=True)}
    truth |= {(name, "N m s/rad"): x for name, x in zip(names, VISCOUS, strict=True)}
    truth |= {("wrist_3_joint", "N m s/rad"): VISCOUS[-1] + WRIST, ("wrist_3_joint", "N m"): 0.0}
    assert stated(), "friction is stated"
    wrong = {key: (x, bar) for key, (x, bar) in stated().items() if abs(x - truth[key]) > SIGMAS * bar}
    assert not wrong


def test_each_learned_term_has_a_table_of_its_parameters(guide: tuple[Path, str]) -> None:
    """In Python and in JSON, with names of joints, values, standard deviations and units."""
    folder, _ = guide
    fit = forcegp.load_model(folder / "model")
    assert isinstance(fit, StructuredFit)
    table = fit.parameters()
    assert len(table) >= 2 * system().robot.nq, "viscous and dry friction of each joint at least"
    for each in table:
        assert each.name and each.unit and torch.isfinite(torch.tensor([each.value, each.std])).all()
    out = run("evaluate", "--model", folder / "model", "--data", folder / "test.parquet", "--json")
    assert len(json.loads(out[out.index("{") :])["parameters"]) == len(table), "after progress and warnings"
