"""Scenes that are small and take long, or recurse without end."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from forcegp.errors import SceneError
from forcegp.scene import load_scene

SLOW = 5.0
"""Seconds: what no refusal may take, on a busy machine."""

ROBOT = '[robot]\nmodel = "double_pendulum"\n'

HOSTILE = {
    "a key of 20,000 parts": ".".join("a" * 20_000) + " = 1",
    "a key of 3000 parts": ".".join("a" * 3000) + " = 1",
    "a table of 3000 parts": "[" + ".".join("a" * 3000) + "]",
    "a quoted key": ".".join(['"a"'] * 3000) + " = 1",
    "a key with spaces": " . ".join("a" * 3000) + " = 1",
    "a key inside a table": "x = { " + ".".join("a" * 3000) + " = 1 }",
    "nested lists": "x = " + "[" * 300 + "]" * 300,
    "very nested lists": "x = " + "[" * 100_000 + "]" * 100_000,
    "nested tables": "x = " + "{a = " * 300 + "1" + "}" * 300,
    "nested arrays of tables": "".join(f"[[{'.'.join('a' * n)}]]\n" for n in range(1, 17)) + "a.a = [[[1]]]",
    "100,000 keys": "\n".join(f"k{i} = 1" for i in range(100_000)),
    "100,000 tables": "\n".join(f"[t{i}]" for i in range(100_000)),
    "1,900 tables of 16 parts": "\n".join("[" + ".".join("abcdefghijklmno") + f".t{i}]" for i in range(1900)),
    "a name of a megabyte": "a" * 1_000_000 + " = 1",
    "a line of a megabyte": "a" * 1_000_000,
    "a megabyte of dots": "." * 1_000_000,
    "an unknown contact": "[[contact]]\n" * 50_000,
    "a number of 100,000 digits": "x = " + "1" * 100_000,
    "a huge exponent": "[baumgarte]\nnatural_frequency = 1e999999",
    "a lone surrogate": 'x = "\\ud800"',
    "a null character": "x = \x00",
}
NAMES = {"too long": "a" * 5000, "with a null character": "a\\u0000b", "a folder": ".", "empty": ""}


@pytest.mark.parametrize("name", NAMES)
def test_a_robot_whose_name_no_file_can_have_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(f'[robot]\nmodel = "{NAMES[name]}"\n')
    with pytest.raises(SceneError, match="no such robot"):
        load_scene(tmp_path / "scene.toml").system()


def test_a_scene_whose_name_no_file_can_have_is_refused() -> None:
    with pytest.raises(SceneError, match="no such scene"):
        load_scene("a" * 5000)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_scene_is_refused_in_no_time(name: str, tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(ROBOT + HOSTILE[name] + "\n")
    start = time.perf_counter()
    with pytest.raises(SceneError, match=r"scene\.toml"):
        load_scene(tmp_path / "scene.toml").system()
    assert time.perf_counter() - start < SLOW


def test_numbers_and_paths_are_no_keys(tmp_path: Path) -> None:
    robot = 'model = "double_pendulum" # see a.b.c.d.e.f for 1.2.3\nbase_position = [0.0, 0.5, 1.25]\n'
    (tmp_path / "scene.toml").write_text("[robot]\n" + robot)
    assert load_scene(tmp_path / "scene.toml").robot().nq == 2
