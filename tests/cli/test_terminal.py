"""Control characters of paths, keys and column names reach no terminal."""

from __future__ import annotations

import os
import select
import subprocess
import sys
from pathlib import Path

import pytest
from click import unstyle

ESCAPE = "\x1b]0;owned\x07\x1b[2J\u202e"


def shown(*arguments: str) -> bytes:
    """What a command writes to a terminal."""
    import pty

    master, slave = pty.openpty()
    command = [sys.executable, "-m", "forcegp", *arguments]
    with subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave) as process:
        os.close(slave)
        text = b""
        while select.select([master], [], [], 60.0)[0]:
            try:
                text += os.read(master, 1 << 16)
            except OSError:  # the other side is closed
                break
        process.wait()
    os.close(master)
    return text


@pytest.mark.skipif(os.name != "posix", reason="terminals of POSIX")
@pytest.mark.parametrize("place", ["key", "path", "column", "text"])
def test_control_characters_are_shown_escaped(place: str, tmp_path: Path) -> None:
    scene, log = tmp_path / "scene.toml", tmp_path / "run.csv"
    scene.write_text('[robot]\nmodel = "double_pendulum"\n')
    log.write_text("t,a\n" + "\n".join(f"{k},{k}" for k in range(40)))
    if place == "key":
        key = "".join(f"\\u{ord(c):04x}" for c in ESCAPE)
        scene.write_text(f'[robot]\nmodel = "double_pendulum"\n"{key}" = 1\n')
        arguments = ["simulate", "--scene", str(scene), "--out", str(tmp_path / "x.parquet")]
    elif place == "path":
        arguments = ["check", "--robot", "double_pendulum", "--data", str(tmp_path / f"{ESCAPE}.csv")]
    elif place == "column":
        log.write_text(f"t,a{ESCAPE},a{ESCAPE}\n" + "\n".join(f"{k},{k},{k}" for k in range(40)))
        arguments = ["check", "--robot", "double_pendulum", "--data", str(log)]
    else:
        named = tmp_path / f"{ESCAPE}.csv"
        named.write_text(log.read_text())
        arguments = ["import", str(named), "--robot", "double_pendulum", "--out", str(tmp_path / "x.parquet")]
    text = shown(*arguments)
    assert b"error" in text and b"x1b]0;owned" in text
    assert b"\x1b]0;owned" not in text and b"\x1b[2J" not in text and "\u202e".encode() not in text


@pytest.mark.parametrize("columns", [None, "40", "70"])
def test_prose_is_wrapped_at_the_width_of_the_terminal(
    columns: str | None, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    from forcegp.cli import common

    text, path, line = " ".join(["word"] * 40), "/tmp/" + 30 * "long-name-", "surface = { offset = 0.1 } " * 5
    monkeypatch.setenv("COLUMNS", columns or "40")
    for stream in (sys.stdout, sys.stderr):
        monkeypatch.setattr(stream, "isatty", lambda: columns is not None)
    common.show({"text": text, "file": path, "line": common.Verbatim(line)}, as_json=False)
    common.warn(f"{text} of {path}")
    out, err = (unstyle(text).splitlines() for text in capfd.readouterr())
    assert f"line  {line}" in out
    if columns is None:
        assert [*out, *err] == [
            f"text  {text}",
            f"file  {path}",
            f"line  {line}",
            f"warning: {text} of {path}",
        ]
    else:
        rest = [row for row in (*out, *err) if path not in row and line not in row]
        assert max(map(len, rest)) <= int(columns) and any(path in row for row in err)
        assert " ".join(" ".join(err).split()) == f"warning: {text} of {path}"
        assert " ".join(" ".join(out).split()).startswith(f"text {text}")
        assert all(row.startswith("      ") for row in out if row.strip().startswith("word"))
