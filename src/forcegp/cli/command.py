"""The function that every command passes: it refuses results that would overwrite an input.

Nothing is computed before. Options for results are marked `writable=True`. All other paths, and scenes,
robots and mappings, are inputs. The robot file of a scene and the meshes and included files of a robot are
inputs as well.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import wraps
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from typer.models import ParameterInfo

from forcegp.errors import ForceGPError
from forcegp.guards import is_file

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

BUNDLED = {
    "scene": "scene/bundled/{}.toml",
    "robot": "robot/bundled/{}.urdf",
    "mapping": "logs/bundled/{}.toml",
    "target": "scene/bundled/{}.toml",
}
"""Files of bundled names, by the options that accept a name or a path."""
MODELS = ("model", "target")
"""Options that accept the path of a model without its suffix."""
FOLDERS = ("log",)
"""Options that accept a folder; elsewhere, a folder of the same name is no input."""
MESH_FOLDERS = ("meshdir", "assetdir", "texturedir")
"""Attributes in an MJCF file that name folders of other files."""


R = TypeVar("R")


def keeping_inputs(function: Callable[..., R]) -> Callable[..., R]:
    """Return a command that raises `DestinationError` if a result would overwrite an input, and else runs."""

    @wraps(function)
    def run(**values: Any) -> R:
        from forcegp.destination import check_kept

        outputs = list(outputs_of(function, values))
        if outputs:
            check_kept(outputs, inputs_of(function, values))
        return function(**values)

    return run


def paths_of(function: Callable[..., Any]) -> dict[str, bool]:
    """Return whether each option of a command that accepts a path names a result, by its name."""
    results = {}
    for name, hint in get_type_hints(function, include_extras=True).items():
        info = next((x for x in getattr(hint, "__metadata__", ()) if isinstance(x, ParameterInfo)), None)
        if info is not None and (name in BUNDLED or Path in _types(hint)):
            results[name] = info.writable
    return results


def _types(hint: Any) -> Iterator[Any]:
    """Yield a type and the types that it is made of."""
    yield hint
    for part in get_args(hint):
        yield from _types(part)


def outputs_of(function: Callable[..., Any], values: Mapping[str, Any]) -> Iterator[Path]:
    """Yield every path that a command with these values writes."""
    for name, written in paths_of(function).items():
        value = values.get(name)
        if written and value is not None:
            places = PLACES.get((function.__name__, name))
            yield from [value] if places is None or not value.name else places(value, values)


def inputs_of(function: Callable[..., Any], values: Mapping[str, Any]) -> Iterator[Path]:
    """Yield every path that a command with these values may read, and the files named in these files."""
    for name, written in paths_of(function).items():
        value = values.get(name)
        if not written and value is not None:
            for each in value if isinstance(value, list | tuple) else [value]:
                paths = _meant(name, str(each))
                yield from _with_named(paths if name in FOLDERS else filter(is_file, paths))


def _meant(name: str, value: str) -> Iterator[Path]:
    """Yield the paths that the value of an option may mean."""
    from forcegp.storage.model_file import model_path

    yield Path(value)
    yield Path(os.path.expanduser(value))
    if name in MODELS and Path(value).name:
        yield model_path(value)
    if name in BUNDLED:
        yield Path(str(files("forcegp"))) / BUNDLED[name].format(value)


def _with_named(paths: Iterable[Path]) -> Iterator[Path]:
    """Yield paths, and the files that scenes and robot files among them name."""
    queue, seen, roots = list(paths), set[Path](), list[Path]()
    while queue:
        path = queue.pop()
        if path not in seen:
            seen.add(path)
            yield path
            with suppress(OSError, ValueError, ForceGPError):  # the reader of the file reports its errors
                queue += _named(path, roots)


def _named(path: Path, roots: list[Path]) -> list[Path]:
    """Return the existing files that a scene or a robot file names.

    Names in an included file start at the folders of the file that includes it as well; `roots` collects
    these folders. Names of packages start at a parent of the folder.
    """
    from forcegp.robot.safety import parse_xml, read_bytes

    if path.suffix.lower() == ".toml":
        robot = tomllib.loads(path.read_text(encoding="utf-8")).get("robot", {})
        return [path.parent / robot["model"]] if isinstance(robot, dict) and "model" in robot else []
    if path.suffix.lower() not in (".urdf", ".xml", ".mjcf"):
        return []
    folder, elements = path.parent, list(parse_xml(read_bytes(path), str(path)).iter())
    roots += [folder, *(folder / x for e in elements for name in MESH_FOLDERS if (x := e.get(name)))]
    names = [x for e in elements for name in ("file", "filename") if (x := e.get(name))]
    packages = [folder, *folder.resolve().parents]
    in_packages = [name.rpartition("://")[2] for name in names if "://" in name]
    places = [root / name for name in in_packages for root in packages]
    places += [folder / name.partition("/")[2] for name in in_packages]
    places += [root / name for name in names for root in roots]
    return list(filter(Path.is_file, places))


Places = Callable[[Path, Mapping[str, Any]], Iterable[Path]]


def _model(out: Path, _: Mapping[str, Any]) -> list[Path]:
    from forcegp.storage.model_file import model_path

    return list(dict.fromkeys([out, model_path(out)]))


def _robot_files(out: Path, values: Mapping[str, Any]) -> list[Path]:
    from forcegp.models.calibrated import written_files

    return [out] if values["to"] not in ("urdf", "mjcf") else written_files(out, values["samples"])


def _fits(out: Path, values: Mapping[str, Any]) -> list[Path]:
    from forcegp.sweep import fits_of

    fits = fits_of(values["scene"], values["model"], range(values["seeds"]))
    return [out] if out.is_file() else [out / fit.name for fit in fits]


PLACES: dict[tuple[str, str], Places] = {
    ("fit", "out"): _model,
    ("excite", "out"): lambda out, _: [out, out.with_suffix(".html")],
    ("export", "out"): _robot_files,
    ("sweep", "out"): _fits,
}
"""Paths written by options that do not write exactly the path that they name."""
