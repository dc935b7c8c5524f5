"""Functions shared by commands: progress bars, output of results, and input of data for a robot."""

from __future__ import annotations

import json
import math
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import typer

import forcegp
from forcegp.errors import DataError, ForceGPError, ParameterError
from forcegp.files import finite

if TYPE_CHECKING:
    from forcegp.models.base import FittedModel, Predictor
    from forcegp.models.configured import Configured
    from forcegp.scene import ModelTable


class Advance(Protocol):
    """A function that advances a progress bar. `note` is a short status, such as the objective."""

    def __call__(self, done: int, total: int | None = None, note: str = "") -> None: ...


def printable(text: object) -> str:
    """Escape control characters, since names in files may contain terminal commands.

    >>> printable("a\\x1b[2Jb")
    'a\\\\x1b[2Jb'
    """
    return "".join(
        c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in str(text)
    )


WHOLE = ("break_long_words", "break_on_hyphens")
"""Ways to break words, which would damage paths and names."""


class Verbatim(str):
    """A line to copy into a file, which is not wrapped."""


def say(text: object, label: str = "", indent: int = 2, err: bool = False, **style: Any) -> None:
    """Print a text after a styled label, wrapped at the width of the terminal, but not in files and pipes."""
    lines = printable(f"{label}{text}").splitlines()
    if (sys.stderr if err else sys.stdout).isatty() and not isinstance(text, Verbatim):
        width, whole = max(terminal_width(), 2 * indent), dict.fromkeys(WHOLE, False)
        lines = [textwrap.fill(line, width, subsequent_indent=" " * indent, **whole) for line in lines]
    printed = "\n".join(lines)
    typer.secho(printed[: len(label)], nl=False, err=err, reset=bool(style), **style)
    typer.echo(printed[len(label) :], err=err)


def terminal_width() -> int:
    """Return the number of columns of the terminal, or 80 without one."""
    return shutil.get_terminal_size().columns


def warn(text: object) -> None:
    """Print a warning to stderr."""
    say(text, "warning: ", err=True, fg="yellow")


@contextmanager
def progress_bar(description: str, total: int) -> Iterator[Advance]:
    """Yield a function that updates a progress bar on stderr with completed steps, a new total and a note."""
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    times = (TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.fields[note]}"))
    console = Console(stderr=True)
    # No bar is shown if the output is a file or a pipe.
    with Progress(*columns, *times, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(escape(printable(description)), total=total, note="")
        yield lambda done, total=None, note="": bar.update(task, completed=done, total=total, note=note)


def show(result: Mapping[str, object], as_json: bool) -> None:
    """Print the nonempty values of a result, one per line, or print all values as JSON."""
    if as_json:
        typer.echo(json.dumps(finite(dict(result)), default=str, allow_nan=False))
        return
    fields = {name: value for name, value in result.items() if value is not None and value not in ("", ())}
    names = {name: named(name) for name in fields}
    width = max(map(len, names.values()))
    for name, value in fields.items():
        text = ", ".join(map(str, value)) if isinstance(value, list | tuple) else value
        text = f"{value:.6g}" if isinstance(value, float) else text
        say(text, f"{names[name]:<{width}}  ", indent=width + 2)


UNITS = {"rad_s2": "rad/s²", "m_s": "m/s", "Nm": "N m", "N": "N", "m": "m", "s": "s"}
"""Units at the end of names of fields."""


def named(name: str) -> str:
    """Return the name of a field in words, with its unit in brackets.

    >>> named("tool_speed_m_s"), named("training_points")
    ('tool speed [m/s]', 'training points')
    """
    for end, unit in UNITS.items():
        if name.endswith(f"_{end}"):
            return f"{name.removesuffix(f'_{end}').replace('_', ' ')} [{unit}]"
    return name.replace("_", " ")


def rounded(value: float, std: float | None = None, digits: int = 2) -> str:
    """Return a value with its standard deviation, rounded to one or two digits of the latter, if known.

    >>> rounded(4.2496, 0.0374), rounded(123.4, 21.0), rounded(0.012), rounded(3.212, 0.024, digits=1)
    ('4.25 ± 0.04', '123 ± 21', '0.012', '3.21 ± 0.02')
    """
    if std is None or not (math.isfinite(std) and std > 0.0):
        return f"{value:.3g}"
    places = max(0, 1 - math.floor(math.log10(std / (0.355 if digits == 2 else 0.1))))
    return f"{value:.{places}f} ± {std:.{places}f}"


def show_table(rows: Sequence[Sequence[str]]) -> None:
    """Print rows of texts in aligned columns; the first row is the head."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (f"{text:<{width}}" for text, width in zip(row, widths, strict=True))
        say(Verbatim("  ".join(cells).rstrip()))


def save(write: Callable[[Path], object], out: Path) -> None:
    """Write a result by `write(out)` or, if that fails, to a different path that the error names."""
    from forcegp.destination import write_or_keep

    write_or_keep(write, out)


def check_data_destination(path: Path) -> None:
    """Check, before long computations, that a data set can be written."""
    from forcegp.data.table import check_ending
    from forcegp.destination import check_destination

    check_ending(path)
    check_destination(path)


def derivatives(window: int | None) -> forcegp.data.SavitzkyGolay | None:
    """Return the filter with a given window, or `None` if no window is given."""
    return None if window is None else forcegp.data.SavitzkyGolay(window=window)


def read_data(
    path: Path, robot: forcegp.RobotModel | None = None, differentiate: int | None = None
) -> forcegp.Dataset:
    """Read a data set with joints ordered as in a robot, and compute derivatives if a window is given."""
    data = forcegp.Dataset.read(path, differentiate=derivatives(differentiate))
    if robot is not None and set(robot.joint_names) <= set(data.joint_names):
        data = data.select(robot.joint_names)
    if robot is not None:
        data.check_robot(robot)
    return data


def trajectory_from(data: forcegp.Dataset, start: int, purpose: str) -> forcegp.Dataset:
    """Return the rows from `start` to the end of their trajectory."""
    if not data.header.ordered:
        text, hint = f"a {purpose} needs a log in time order", "pass the log from which they were selected"
        raise DataError(text, got="points in order of selection", hint=hint)
    if start >= len(data):
        raise DataError("there is no such row to start from", expected=f"0 to {len(data) - 1}", got=start)
    rest = data[start:]
    return rest[rest.segment == rest.segment[0]]


def fitted(model: Configured, data: Any, **options: Any) -> FittedModel:
    """Fit a model while showing a progress bar with the objective."""

    with progress_bar(f"fitting {model.name}", 1) as advance:

        def progress(done: int, most: int, value: float) -> None:
            advance(done, most, "" if math.isnan(value) else f"objective {value:.4g}")

        return model.fit(data, progress=progress, **options)


def words(text: str | None) -> tuple[str, ...]:
    """Return the words in a comma-separated list.

    >>> words("fx, fz")
    ('fx', 'fz')
    """
    return tuple(word.strip() for word in (text or "").split(",") if word.strip())


def numbers(option: str, text: str | None, count: int | None = None) -> tuple[float, ...]:
    """Return the numbers in a comma-separated list; raise `ParameterError` unless there are `count`."""
    try:
        values = tuple(map(float, words(text)))
    except ValueError:
        values = (math.nan,)
    if any(map(math.isnan, values)) or count not in (None, len(values)):
        expected = "comma-separated numbers" if count is None else f"{count} comma-separated numbers"
        raise ParameterError(f"--{option} is not a list of numbers", expected=expected, got=text)
    return values


def check_robot_named(scene: str | None, robot: str | None) -> None:
    """Check that exactly one of a scene and a robot is given."""
    if (scene is None) == (robot is None):
        problems = "no robot was given", "both --scene and --robot were given"
        raise ForceGPError(problems[scene is not None], hint="pass either --scene or --robot")


def system_of(scene: str | None, robot: str | None) -> forcegp.ConstrainedSystem:
    """Return the robot of a scene with its contacts, or a robot without contacts."""
    check_robot_named(scene, robot)
    if scene is not None:
        return forcegp.load_scene(scene).system()
    return forcegp.ConstrainedSystem(forcegp.load_robot(str(robot)))


def model_table(config: Path | None, scene: str | None) -> ModelTable:
    """Return the table [model] from a separate file if one is given, or else from the scene, if any."""
    from forcegp.scene import default_model_table, load_model_table

    if config is not None:
        return load_model_table(config)
    return default_model_table() if scene is None else forcegp.load_scene(scene).model


def warn_beyond(model: Predictor, data: forcegp.Dataset, doubts: Iterable[str] = ()) -> None:
    """Warn about questionable predictions and about states far from the training data."""
    from forcegp.forces.posterior import warnings_beyond
    from forcegp.models.structured_fit import StructuredFit

    beyond = model.beyond(data.qd, data.tau) if isinstance(model, StructuredFit) else None
    for doubt in (*doubts, *(() if beyond is None else warnings_beyond(beyond, data.joint_names))):
        warn(doubt)
