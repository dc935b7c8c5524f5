"""An interrupt ends every command within 2 s with code 130, without a traceback and without workers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ENDED = 2.0
"""Time to end after an interrupt [s], of which waiting is 0.7 s."""
SCRIPT = """
import hashlib, multiprocessing, signal, sys, time
from pathlib import Path

import typer

from forcegp.cli import main

app = typer.Typer()

@app.command()
def orderly() -> None:
    ready()
    time.sleep(60.0)

@app.command()
def swallowing() -> None:
    ready()
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        try:
            time.sleep(60.0)
        except BaseException:
            pass

@app.command()
def within_c() -> None:
    ready()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 1 << 28)

@app.command()
def with_worker() -> None:
    worker = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60.0,))
    worker.start()
    Path(sys.argv[2]).with_name("worker").write_text(str(worker.pid))
    ready()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 1 << 28)

def ready() -> None:
    Path(sys.argv[2]).write_text("")

if __name__ == "__main__":
    # Background jobs of a shell start with SIGINT ignored, and so do their children.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    main(lambda: app([sys.argv[1]]))
"""


IMPORTING = """
import os, signal, sys

signal.signal(signal.SIGINT, signal.default_int_handler)

class Interrupting:
    \"\"\"Sends an interrupt at an import, and replaces its exception, as a compiled module does.\"\"\"

    def find_spec(self, name, path=None, target=None):
        if name == os.environ["MODULE"]:
            try:
                os.kill(os.getpid(), signal.SIGINT)
                os.getpid()
            except BaseException as error:
                raise ImportError("initialization failed") from error

sys.meta_path.insert(0, Interrupting())
from forcegp.__main__ import main
main()
"""
IMPORTED = (
    "forcegp.cli",
    "typer",
    "forcegp.checks",
    "torch",
    "torch.autograd",
    "scipy.optimize",
    "forcegp.gp",
)


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("module", IMPORTED)
def test_an_interrupt_during_an_import_ends_the_program(module: str, tmp_path: Path) -> None:
    script = tmp_path / "command.py"
    script.write_text(IMPORTING)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "MODULE": module}
    arguments = [sys.executable, script, "check", "-s", "kuka_plane", "-d", tmp_path / "run.parquet"]
    done = subprocess.run(arguments, capture_output=True, env=environment, timeout=60.0, check=False)
    assert (done.returncode, done.stderr) == (130, b"")


REPLACED = """
import signal, time

signal.signal(signal.SIGINT, signal.default_int_handler)
import forcegp.__main__

signal.signal(signal.SIGINT, signal.default_int_handler)
try:
    signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt:
    time.sleep(1.0)
    print("alive")
"""


AT_THE_END = """
import os, signal, sys
from forcegp.interrupt import end_when_interrupted

class Last:
    def __del__(self, kill=os.kill, process=os.getpid(), number=signal.SIGINT):
        kill(process, number)

signal.signal(signal.SIGINT, signal.default_int_handler)
end_when_interrupted()
sys.last = Last()  # is deleted while the interpreter shuts down
sys.exit(3)
"""


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_an_interrupt_during_the_shutdown_leaves_the_exit_code() -> None:
    done = subprocess.run([sys.executable, "-c", AT_THE_END], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (3, "")


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_an_interrupt_with_another_handler_does_not_end_the_program() -> None:
    arguments = [sys.executable, "-c", REPLACED]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=60.0, check=False)
    assert (done.returncode, done.stdout) == (0, "alive\n"), done.stderr


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("command", ["orderly", "swallowing", "within-c", "with-worker"])
def test_an_interrupt_ends_a_command(command: str, tmp_path: Path) -> None:
    script, ready = tmp_path / "command.py", tmp_path / "ready"
    script.write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    arguments = [sys.executable, script, command, ready]
    process = subprocess.Popen(arguments, stderr=subprocess.PIPE, env=environment)
    try:
        end = time.monotonic() + 60.0
        while not ready.exists() and time.monotonic() < end and process.poll() is None:
            time.sleep(0.05)
        assert ready.exists()
        process.send_signal(signal.SIGINT)
        _, text = process.communicate(timeout=ENDED)
    finally:
        process.kill()
    assert process.returncode == 130 and b"Traceback" not in text
    worker = tmp_path / "worker"
    assert command != "with-worker" or not Path(f"/proc/{worker.read_text()}").exists()
