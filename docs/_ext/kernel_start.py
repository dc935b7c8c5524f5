"""Run at the start of each page's kernel: `%%bash` cells whose output comes in one piece, without colours.

The magic of IPython passes output on in pieces of 100 bytes, which end up on lines of their own, and its
kernel asks programs for colours and progress bars.
"""

import os
import subprocess

from IPython import get_ipython

PLAIN = {"NO_COLOR": "1", "TERM": "dumb", "COLUMNS": "96"}
NOISE = "pybullet build time"


def run_shell(line: str, cell: str) -> None:
    """Run a cell in bash, and print what it prints; a failure ends the build."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("FORCE_COLOR", "CLICOLOR"))}
    command = ["bash", *line.split()]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    done = subprocess.run(command, input=cell, env=kept | PLAIN, text=True, check=False, **streams)
    print("".join(row for row in done.stdout.splitlines(keepends=True) if not row.startswith(NOISE)), end="")
    if done.returncode:
        raise RuntimeError(f"the shell ended with exit code {done.returncode}")


shell = get_ipython()
if shell is not None:
    shell.register_magic_function(run_shell, "cell", "bash")
