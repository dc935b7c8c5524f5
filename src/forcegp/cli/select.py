"""`forcegp select`: training and test data from a log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from forcegp.cli.common import (
    AsJson,
    Differentiate,
    check_data_destination,
    progress_bar,
    read_data,
    show,
)

if TYPE_CHECKING:
    from forcegp.data import Dataset
    from forcegp.data.split import Split


def select(
    log: Annotated[Path, typer.Argument(help="Data set to select from, .parquet or .csv.")],
    count: Annotated[int, typer.Option("--count", "-n", min=1, help="Number of training points.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Where the training points go (.parquet).")],
    rest: Annotated[Path | None, typer.Option(help="Where the test points go (.parquet).")] = None,
    split: Annotated[
        Literal["selection", "stretches"],
        typer.Option(help="Test on all points not selected (the paper), or on held-out stretches of motion."),
    ] = "selection",
    stretch: Annotated[float, typer.Option(help="Duration of a held-out stretch in seconds.")] = 3.0,
    fraction: Annotated[float, typer.Option(help="Part of the motion that is held out.")] = 0.2,
    margin: Annotated[float, typer.Option(help="Time kept free beside held-out stretches in seconds.")] = 0.0,
    method: Annotated[
        Literal["farthest", "even", "random"], typer.Option(help="How training points are chosen.")
    ] = "farthest",
    keep_impacts: Annotated[
        bool, typer.Option("--keep-impacts", help="Keep rows that the log marks as near an impact.")
    ] = False,
    differentiate: Differentiate = None,
    seed: Annotated[int, typer.Option(help="Seed of the held-out stretches and of a random choice.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Select training points that cover a log, and keep the rest for testing.

    Farthest point sampling on standardized positions, velocities and torques: exact, deterministic, and
    in the order of selection, so that the first k rows are the selection of k points.

    [bold]Examples[/bold]

    forcegp select run.parquet -n 1000 --out train.parquet --rest test.parquet

    forcegp select run.csv -n 400 --split stretches --differentiate 11 -o train.parquet --rest test.parquet
    """
    from forcegp.data import split_by_selection, split_by_stretches, without_marked_impacts

    check_data_destination(out, log)
    if rest is not None:
        check_data_destination(rest, log, out)
    whole = read_data(log, differentiate)
    data = whole if keep_impacts else without_marked_impacts(whole)
    held_out = {"stretch": stretch, "fraction": fraction, "margin": margin}
    with progress_bar("selecting points", count) as progress:
        if split == "selection":
            parts = split_by_selection(data, count, method=method, seed=seed, progress=progress)
        else:
            parts = split_by_stretches(data, count, **held_out, method=method, seed=seed, progress=progress)
    how = f"of {len(data)} rows by {method} points, split by {split}, seed {seed}"
    result = _written(data, parts, how, out, rest)
    if len(data) < len(whole):
        result["rows_at_impacts_left_out"] = len(whole) - len(data)
    show(result, as_json)


def _written(data: Dataset, parts: Split, how: str, out: Path, rest: Path | None) -> dict[str, object]:
    """Write training and test points, and say what was written."""
    from forcegp.destination import write_or_keep

    count = len(parts.train)
    write_or_keep(data[parts.train].with_step(f"selected {count} training points {how}").write, out)
    result: dict[str, object] = {"training_points": count, "training_file": str(out)}
    if rest is not None:
        write_or_keep(data[parts.test].with_step(f"kept {len(parts.test)} test points {how}").write, rest)
        result |= {"test_points": len(parts.test), "test_file": str(rest)}
    if parts.stretches:
        result["held_out_rows"] = [list(rows) for rows in parts.stretches]
    return result
