"""An external wrench on the command line: where it acts, and which components it has."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

import forcegp
from forcegp.cli import app
from forcegp.errors import ForceGPError, ParameterError, UnknownNameError
from forcegp.models.structured_fit import StructuredFit
from logs import random_log

ROBOT = forcegp.load_robot("double_pendulum")
FRAME = ROBOT.frame_names[-1]


@pytest.fixture(scope="module")
def fit(tmp_path_factory: pytest.TempPathFactory) -> tuple[StructuredFit, forcegp.Dataset, Path]:
    folder = tmp_path_factory.mktemp("wrench")
    log = random_log(60, joints=ROBOT.joint_names)
    options = forcegp.models.LearningOptions(max_evaluations=2)
    model = forcegp.StructuredGP(
        forcegp.ConstrainedSystem(ROBOT), "analytical", [forcegp.priors.JointFrictionPrior()], noise=0.5
    )
    found = model.fit(log[::2], options=options)
    found.save(folder / "model")
    log.write(folder / "log.parquet")
    return found, log, folder


def predicted(folder: Path, *words: str) -> forcegp.Dataset:
    common = ["predict", "-m", folder / "model", "-d", folder / "log.parquet", "-o", folder / "out.parquet"]
    done = CliRunner().invoke(app, [*map(str, common), "-q", "external_wrench", "--frame", FRAME, *words])
    if done.exception is not None:
        raise done.exception
    return forcegp.Dataset.read(folder / "out.parquet")


def test_the_point_and_the_components_are_those_of_python(
    fit: tuple[StructuredFit, forcegp.Dataset, Path],
) -> None:
    model, log, folder = fit
    found = predicted(folder, "--point", "0.1, 0,-0.2", "--axes", "fz,mx", "--reference", "local")
    ours = model.external_wrench(log, FRAME, point=(0.1, 0.0, -0.2), axes=("fz", "mx"), reference="local")
    elsewhere = model.external_wrench(log, FRAME, axes=("fz", "mx"), reference="local")
    assert not torch.allclose(ours.mean, elsewhere.mean)
    for part, place, k in (("force", 2, 0), ("moment", 0, 1)):
        for ending, values in (("", ours.mean), ("_std", ours.std)):
            column = found.contact_extras[f"predicted_external_{part}{ending}"][FRAME]
            assert values is not None
            torch.testing.assert_close(column[:, place], values[:, k])
            others = [x for x in range(3) if x != place]
            assert not bool(column[:, others].any())


def test_all_components_at_the_origin_are_the_default(
    fit: tuple[StructuredFit, forcegp.Dataset, Path],
) -> None:
    model, log, folder = fit
    found, ours = predicted(folder), model.external_wrench(log, FRAME)
    columns = [found.contact_extras[f"predicted_external_{part}"][FRAME] for part in ("force", "moment")]
    torch.testing.assert_close(torch.cat(columns, dim=1), ours.mean)


@pytest.mark.parametrize(
    ("words", "error", "text"),
    [
        (("--point", "0,0"), ParameterError, "3 comma-separated numbers"),
        (("--point", "0,0,up"), ParameterError, "--point is not a list of numbers"),
        (("--point", "0,0,inf"), ParameterError, "invalid point of application"),
        (("--axes", "fx,fw"), UnknownNameError, "unknown component of a wrench 'fw'"),
        (("--axes", ""), ParameterError, "invalid components of a wrench"),
    ],
)
def test_other_words_are_refused(
    words: tuple[str, ...],
    error: type[ForceGPError],
    text: str,
    fit: tuple[StructuredFit, forcegp.Dataset, Path],
) -> None:
    with pytest.raises(error, match=text):
        predicted(fit[2], *words)
