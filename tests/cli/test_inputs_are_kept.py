"""No result replaces what it is made from: every result of every command against every input of it.

The pairs come from the command line itself. The inputs are damaged files, so that a command that reads one
of them before it refuses ends in another error.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
from typer.models import ArgumentInfo, ParameterInfo
from typer.testing import CliRunner

from forcegp.cli import app
from forcegp.cli.command import BUNDLED, inputs_of, outputs_of, paths_of
from forcegp.destination import check_kept
from forcegp.errors import DestinationError, ForceGPError

Function = Callable[..., object]
COMMANDS: dict[str, Function] = {
    str(each.name or getattr(each.callback, "__name__", "")): each.callback
    for each in app.registered_commands
    if each.callback is not None
}
PAIRS = [
    (name, result, given)
    for name, command in COMMANDS.items()
    for result, written in paths_of(command).items()
    for given, read in paths_of(command).items()
    if written and not read
]
WORDS = {
    *("model", "engine", "contact", "address", "quantity", "frame", "reference", "stabilization", "method"),
    *("to", "name", "start", "velocity", "acceleration", "torque", "box", "criterion", "tip_radius"),
    *("axes", "point", "recording"),
}
"""Options that accept text and no path."""
NUMBER = "3"


def same(out: Path) -> Path:
    return out


def spelt_otherwise(out: Path) -> Path:
    (out.parent / "below").mkdir()
    return out.parent / "below" / ".." / out.name


def linked(out: Path) -> Path:
    (out.parent / "link").mkdir()
    (out.parent / "link" / out.name).symlink_to(out)
    return out.parent / "link" / out.name


def hard_linked(out: Path) -> Path:
    (out.parent / "hard").mkdir()
    os.link(out, out.parent / "hard" / out.name)
    return out.parent / "hard" / out.name


def in_a_linked_folder(out: Path) -> Path:
    (out.parent / "folder").symlink_to(out.parent)
    return out.parent / "folder" / out.name


def made(folder: Path, name: str) -> Path:
    """A damaged file for an option."""
    path = folder / f"{name}.{'safetensors' if name == 'model' else 'toml' if name == 'scene' else 'parquet'}"
    path.write_text("damaged")
    return path


def info_of(command: Function, name: str) -> ParameterInfo:
    hint = get_type_hints(command, include_extras=True)[name]
    return next(x for x in hint.__metadata__ if isinstance(x, ParameterInfo))


def option(command: Function, name: str) -> str:
    names = getattr(info_of(command, name), "param_decls", None) or ()
    return names[0] if names else f"--{name.replace('_', '-')}"


def required(command: Function) -> set[str]:
    parameters = inspect.signature(command).parameters
    return {name for name, parameter in parameters.items() if parameter.default is inspect.Parameter.empty}


def arguments(command: Function, wanted: str, folder: Path) -> list[str]:
    """What a command needs, and the input that is wanted, each a damaged file."""
    words: list[str] = []
    for name in inspect.signature(command).parameters:
        written = paths_of(command).get(name)
        if written or not (name in required(command) or name == wanted):
            continue
        value = str(made(folder, name)) if written is False else NUMBER
        is_argument = isinstance(info_of(command, name), ArgumentInfo)
        words += [value] if is_argument else [option(command, name), value]
    return words


def refused(words: list[str], match: str = "an input of this command would be overwritten") -> None:
    done = CliRunner().invoke(app, words)
    with pytest.raises(DestinationError, match=match):
        raise done.exception or AssertionError(done.output)


def others(command: Function, result: str, folder: Path) -> list[str]:
    """The further results that a command requires, in new places."""
    results = [x for x, written in paths_of(command).items() if written and x in required(command)]
    pairs = ((option(command, x), str(folder / f"new-{x}.parquet")) for x in results if x != result)
    return [word for pair in pairs for word in pair]


@pytest.mark.parametrize("spelling", [same, spelt_otherwise, linked, hard_linked, in_a_linked_folder])
@pytest.mark.parametrize(("name", "result", "given"), PAIRS)
def test_a_result_in_the_place_of_an_input_is_refused(
    name: str, result: str, given: str, spelling: Callable[[Path], Path], tmp_path: Path
) -> None:
    command = COMMANDS[name]
    words = [name, *arguments(command, given, tmp_path), *others(command, result, tmp_path)]
    path = made(tmp_path, given)
    refused([*words, option(command, result), str(spelling(path))])
    assert path.read_text() == "damaged"


@pytest.mark.parametrize("place", [".", ".."])
@pytest.mark.parametrize(("name", "result"), sorted({pair[:2] for pair in PAIRS if pair[0] != "sweep"}))
def test_the_current_folder_is_no_place_for_a_result(
    name: str, result: str, place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sweep writes folders of its own there; everything else needs a name."""
    (tmp_path / "inputs").mkdir()
    (tmp_path / "here" / "below").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here" / "below")
    command = COMMANDS[name]
    words = [name, *arguments(command, "data", tmp_path / "inputs"), *others(command, result, tmp_path)]
    done = CliRunner().invoke(app, [*words, option(command, result), place])
    with pytest.raises(ForceGPError, match=r"current folder|is a folder|no name|as Parquet|no output path"):
        raise done.exception or AssertionError(done.output)


def test_the_pairs_are_of_every_command() -> None:
    assert {name for name, _, _ in PAIRS} == set(COMMANDS)


def test_every_option_is_a_result_an_input_or_a_word() -> None:
    """A new option that accepts text is an input unless it is listed here."""
    for command in COMMANDS.values():
        for name, hint in get_type_hints(command).items():
            if name not in paths_of(command) and str in (hint, *get_args(hint)):
                assert name in WORDS, f"{command.__name__} --{name}: an input or a word?"


@pytest.mark.parametrize("name", ["evaluate", "rollout", "export"])
def test_a_folder_that_holds_an_input_is_not_replaced(name: str, tmp_path: Path) -> None:
    command = COMMANDS[name]
    below = tmp_path / "results" / "logs"
    below.mkdir(parents=True)
    words = arguments(command, "model", below)
    refused([name, *words, "-o", str(tmp_path / "results")])
    assert sorted(path.name for path in below.iterdir())


RESULTS = ("calibrated.urdf", "calibrated.sample_002.urdf", "calibrated.report.json")


@pytest.mark.parametrize("result", RESULTS)
def test_no_file_of_an_export_replaces_a_folder(result: str, tmp_path: Path) -> None:
    """Refused before the model is read, which does not exist."""
    (tmp_path / result).mkdir()
    words = ["export", "--model", str(tmp_path / "model"), "--robot", "ur5", "--to", "urdf", "--samples", "3"]
    refused([*words, "-o", str(tmp_path / "calibrated.urdf")], "is a folder, but a file")


SCENE = '[robot]\nmodel = "robots/arm.urdf"\n'
ARM = '<robot name="arm"><link name="base"><visual><geometry><mesh filename="{}"/></geometry></visual></link>'


@pytest.mark.parametrize("mesh", ["../meshes/base.stl", "package://arm_description/meshes/base.stl"])
@pytest.mark.parametrize("place", ["arm_description/robots/arm.urdf", "arm_description/meshes/base.stl"])
def test_the_files_that_a_scene_names_are_inputs(mesh: str, place: str, tmp_path: Path) -> None:
    root = tmp_path / "arm_description"
    for folder in ("robots", "meshes"):
        (root / folder).mkdir(parents=True)
    (root / "scene.toml").write_text(SCENE)
    (root / "robots" / "arm.urdf").write_text(ARM.format(mesh) + "</robot>")
    (root / "meshes" / "base.stl").write_text("solid")
    refused(
        ["check", "-s", str(root / "scene.toml"), "-d", str(made(tmp_path, "d")), "-o", str(tmp_path / place)]
    )


def test_the_files_that_an_mjcf_file_includes_are_inputs(tmp_path: Path) -> None:
    (tmp_path / "assets").mkdir()
    (tmp_path / "arm.xml").write_text(
        '<mujoco><compiler meshdir="assets"/><include file="parts.xml"/></mujoco>'
    )
    (tmp_path / "parts.xml").write_text('<mujoco><asset><mesh file="link.stl"/></asset></mujoco>')
    (tmp_path / "assets" / "link.stl").write_text("solid")
    words = ["check", "--robot", str(tmp_path / "arm.xml"), "-d", str(made(tmp_path, "d")), "-o"]
    for name in ("parts.xml", "assets/link.stl"):
        refused([*words, str(tmp_path / name)])


@pytest.mark.parametrize(
    ("name", "option", "bundled"), [("check", "-s", "kuka_plane"), ("check", "--robot", "ur5")]
)
def test_the_files_of_bundled_names_are_inputs(name: str, option: str, bundled: str, tmp_path: Path) -> None:
    command, values = COMMANDS[name], {"scene" if option == "-s" else "robot": bundled}
    [path] = [path for path in inputs_of(command, values) if path.is_file() and bundled in path.name]
    refused([name, option, bundled, "-d", str(made(tmp_path, "d")), "-o", str(path)])


def test_a_model_without_its_suffix_is_an_input(tmp_path: Path) -> None:
    model = made(tmp_path, "model")
    refused(["view", str(tmp_path / "model"), "-o", str(model)])
    refused(["export", "-m", str(tmp_path / "model"), "-o", str(model)])


@pytest.mark.parametrize("ending", [".report.json", ".sample_001.urdf"])
def test_what_is_written_beside_a_robot_file_is_a_result_too(ending: str, tmp_path: Path) -> None:
    robot = tmp_path / f"arm{ending}"
    robot.write_text("damaged")
    words = ["export", "-m", str(made(tmp_path, "model")), "--to", "urdf", "--robot", str(robot)]
    refused([*words, "--samples", "2", "-o", str(tmp_path / "arm.urdf")])


def test_the_page_of_a_motion_is_a_result_too(tmp_path: Path) -> None:
    region = tmp_path / "motion.html"
    region.write_text("damaged")
    refused(["excite", "-s", "ur5_free", "--region", str(region), "-o", str(tmp_path / "motion.csv")])


def test_two_results_have_two_places(tmp_path: Path) -> None:
    words = [
        "select",
        str(made(tmp_path, "log")),
        "-n",
        NUMBER,
        "-o",
        str(tmp_path / "part.parquet"),
        "--rest",
    ]
    refused([*words, str(tmp_path / "." / "part.parquet")], "by another result")


@pytest.mark.parametrize(
    ("name", "out"),
    [("fit", "model"), ("fit", "model.safetensors"), ("excite", "motion.csv"), ("export", "arm.urdf")],
)
def test_a_result_is_not_in_its_own_place(name: str, out: str, tmp_path: Path) -> None:
    """With and without the suffix that is appended."""
    values = {"out": tmp_path / out, "to": "urdf", "samples": 2}
    check_kept(outputs_of(COMMANDS[name], values), [])


def test_results_beside_the_inputs_are_allowed(tmp_path: Path) -> None:
    """A fit runs again with the same paths; a sweep writes only the folders of its fits."""
    values = {"data": [tmp_path / "data.parquet"], "scene": "ur5_free", "out": tmp_path / "ur5_free"}
    (tmp_path / "ur5_free.safetensors").write_text("of the first run")
    fit = COMMANDS["fit"]
    assert set(outputs_of(fit, values)).isdisjoint(inputs_of(fit, values))
    sweep = {"scene": [str(tmp_path / "a.toml")], "model": ["sgp"], "seeds": 2, "out": tmp_path}
    assert list(outputs_of(COMMANDS["sweep"], sweep)) == [tmp_path / f"a/sgp/seed-{k}" for k in range(2)]


def test_a_folder_with_the_name_of_an_input_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model without its suffix, and a robot by its name, beside folders with results of the same name."""
    monkeypatch.chdir(tmp_path)
    made(tmp_path, "model")
    for name in ("model", "ur5"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "out.urdf").write_text("an earlier result")
    values = {"model": Path("model"), "out": Path("model")}
    check_kept(outputs_of(COMMANDS["evaluate"], values), inputs_of(COMMANDS["evaluate"], values))
    export = {"model": Path("model"), "robot": "ur5", "out": Path("ur5/out.urdf"), "to": "urdf", "samples": 0}
    check_kept(outputs_of(COMMANDS["export"], export), inputs_of(COMMANDS["export"], export))


def test_a_folder_that_is_read_is_an_input_with_its_files(tmp_path: Path) -> None:
    (tmp_path / "bag" / "parts").mkdir(parents=True)
    part = tmp_path / "bag" / "parts" / "0.parquet"
    part.write_text("damaged")
    refused(["import", str(tmp_path / "bag"), "-s", "ur5_free", "-o", str(part)])


def test_every_name_that_may_be_bundled_is_an_option() -> None:
    assert set(BUNDLED) <= {name for command in COMMANDS.values() for name in paths_of(command)}
