"""Sphinx configuration; `make docs` builds the site, and executes every page on the way."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path

from jupyter_cache import get_cache

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "_ext"))

project = "forcegp"
author = "forcegp developers"
copyright = f"2026, {author}"
release = version = re.findall(r'^version = "(.*)"', (HERE.parent / "pyproject.toml").read_text(), re.M)[0]

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "mathml",
    "messages",
    "plain_docstrings",
    "shell_cells",
]
# The pages offer the wheel of this checkout for download.
WHEELS = HERE.parent / "out" / "wheel"
BUILD = ["-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", WHEELS]
subprocess.run([sys.executable, *BUILD, HERE.parent], check=True)
exclude_patterns = ["_build", "_ext"]
default_role = "code"
smartquotes = False  # options and messages stay as they are typed
nitpicky = False
suppress_warnings = ["myst.header"]  # CHANGELOG.md repeats headings and skips levels

# -- pages: MyST Markdown, executed -----------------------------------------------------------
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist", "substitution"]
myst_substitutions = {"version": version}
myst_heading_anchors = 3
myst_links_external_new_tab = False


def _code_key() -> str:
    """Hash of what the pages run: outputs are cached until the library or an example changes."""
    digest = hashlib.sha256()
    for folder in ("src/forcegp", "examples", "docs/_ext/kernel_start.py"):
        for path in sorted([HERE.parent / folder, *(HERE.parent / folder).rglob("*")]):
            if path.is_file() and path.suffix in (".py", ".toml", ".urdf", ".csv", ".parquet"):
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


nb_execution_mode = os.environ.get("FORCEGP_DOCS_EXECUTE", "cache")
nb_execution_cache_path = str(HERE.parent / "out" / "executed" / _code_key())
get_cache(nb_execution_cache_path).list_cache_records()  # creates its tables before two processes do
nb_execution_in_temp = True
nb_execution_timeout = 600  # of one cell; a busy machine is slow
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_merge_streams = True
nb_number_source_lines = False

# What the pages find in their environment: the command, the example files, one thread, sharp plots.
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
os.environ["PYTHONSTARTUP"] = str(HERE / "_ext" / "kernel_start.py")
os.environ["EXAMPLES"] = str(HERE.parent / "examples")
os.environ["MATPLOTLIBRC"] = str(HERE / "_static" / "matplotlibrc")
os.environ.setdefault("OMP_NUM_THREADS", "1")

# -- reference -----------------------------------------------------------------------------------
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True}
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
add_module_names = False

# -- appearance: no request to another host ------------------------------------------------------
html_theme = "furo"
html_title = f"forcegp {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False

# -- links ---------------------------------------------------------------------------------------
linkcheck_timeout = 20
linkcheck_retries = 2
