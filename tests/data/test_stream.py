"""A log that is read piece by piece is the log that is read at once."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import torch

from forcegp.data import Dataset, SavitzkyGolay, StreamedDataset, stream
from forcegp.data.stream import spaced_sample
from forcegp.errors import DataError
from logs import random_log

SAME_FILTER = 1e-8
"""Of a derivative: the filter runs over other rows; rounding is divided by the square of the period."""
METHOD = SavitzkyGolay(window=11)


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "PIECE_ROWS", 40)


def segmented(n: int = 300, length: int = 77) -> Dataset:
    log = random_log(n)
    return log.replace(segment=5 + 3 * (torch.arange(n) // length))


def joined(pieces: list[Dataset], name: str) -> torch.Tensor:
    return torch.cat([getattr(piece, name) for piece in pieces])


@pytest.mark.parametrize("group", [7, 64, 1000])
def test_pieces_are_the_rows_of_the_files(tmp_path: Path, group: int) -> None:
    """Whatever the row groups; two files have trajectories of their own."""
    log, path = segmented(), tmp_path / "a.parquet"
    log.write(path)
    pq.write_table(pq.read_table(path), path, row_group_size=group)
    read = StreamedDataset((path, path))
    pieces = list(read.pieces())
    assert len(read) == 600
    assert [len(piece) for piece in pieces] == 2 * [40, 40, 40, 40, 40, 40, 40, 20]
    for name in ("t", "q", "qd", "tau", "qdd"):
        assert torch.equal(joined(pieces, name), torch.cat(2 * [getattr(log, name)]))
    expected = torch.arange(300) // 77
    assert torch.equal(joined(pieces, "segment"), torch.cat([expected, 4 + expected]))


def test_the_shares_of_processes_are_the_log(tmp_path: Path) -> None:
    log = segmented()
    log.write(tmp_path / "a.parquet")
    read = StreamedDataset((tmp_path / "a.parquet",))
    shares = [list(read.pieces((rank, 2))) for rank in (0, 1)]
    for number, own in enumerate(read.pieces()):
        found = shares[number % 2][number // 2]
        assert torch.equal(found.q, own.q)
        assert torch.equal(found.segment, own.segment)


@pytest.mark.parametrize("length", [77, 41, 13])
def test_derivatives_do_not_reach_across_trajectories_nor_stop_at_pieces(tmp_path: Path, length: int) -> None:
    path = tmp_path / "a.parquet"
    segmented(260, length).write(path)
    table = pq.read_table(path)
    pq.write_table(table.drop([c for c in table.column_names if c.startswith(("qd.", "qdd."))]), path)
    whole = Dataset.read(path, differentiate=METHOD)
    pieces = list(StreamedDataset((path,), METHOD).pieces())
    for name in ("qd", "qdd"):
        want = getattr(whole, name)
        torch.testing.assert_close(
            joined(pieces, name), want, rtol=0.0, atol=SAME_FILTER * float(want.abs().max())
        )


def test_joints_are_selected_and_kept_in_the_robots_order(tmp_path: Path) -> None:
    log = random_log(60)
    log.write(tmp_path / "a.parquet")
    wanted = tuple(reversed(log.joint_names))
    pieces = list(StreamedDataset((tmp_path / "a.parquet",)).select(wanted).pieces())
    assert pieces[0].joint_names == wanted
    assert torch.equal(joined(pieces, "q"), log.q.flip(-1))


def test_samples_are_evenly_spaced_and_bounded(tmp_path: Path) -> None:
    log = segmented()
    log.write(tmp_path / "a.parquet")
    pieces = StreamedDataset((tmp_path / "a.parquet",) * 2)
    sample, count = spaced_sample(pieces.pieces(), 50)
    assert count == 600 and 50 <= len(sample) < 100
    assert torch.equal(sample.t, torch.cat([log.t, log.t])[:: 600 // len(sample)])
    few, moving = spaced_sample(pieces.pieces(), 50, lambda piece: (piece.q[:, 0] > 0.0).nonzero()[:, 0])
    assert moving == 2 * int((log.q[:, 0] > 0.0).sum()) and bool((few.q[:, 0] > 0.0).all())
    everything, count = spaced_sample(pieces.pieces(), 1000)
    assert len(everything) == count == 600


def test_what_cannot_be_streamed(tmp_path: Path) -> None:
    log = segmented()
    good, bad = tmp_path / "good.parquet", tmp_path / "bad.parquet"
    log.write(good)
    (tmp_path / "a.csv").write_text("t,q.a\n")
    with pytest.raises(DataError, match=r"only Parquet files[\s\S]*\.csv"):
        StreamedDataset((tmp_path / "a.csv",))
    with pytest.raises(DataError, match="no such file"):
        StreamedDataset((tmp_path / "gone.parquet",))
    with pytest.raises(DataError, match="no files"):
        StreamedDataset(())
    log.replace(extras={}).select(log.joint_names[:2]).write(bad)
    with pytest.raises(DataError, match="differ"):
        list(StreamedDataset((good, bad)).pieces())
    bad.write_bytes(good.read_bytes()[:-50])
    with pytest.raises(DataError, match="damaged"):
        StreamedDataset((good, bad))


def test_time_that_jumps_back_between_pieces(tmp_path: Path) -> None:
    """What no piece shows by itself."""
    log = random_log(80)
    t = log.t.clone()
    t[40:] -= 10.0
    points = dataclasses.replace(log, t=t, header=log.header.model_copy(update={"ordered": False}))
    path = tmp_path / "a.parquet"
    points.write(path)
    assert len(list(StreamedDataset((path,)).pieces())) == 2
    table = pq.read_table(path)
    pq.write_table(table.replace_schema_metadata({}), path)
    with pytest.raises(DataError, match="'t' does not increase"):
        list(StreamedDataset((path,)).pieces())
    again = log.replace(segment=(torch.arange(80) // 20) % 2, header=points.header)
    again.write(path)
    pq.write_table(pq.read_table(path).replace_schema_metadata({}), path)
    with pytest.raises(DataError, match="not contiguous"):
        list(StreamedDataset((path,)).pieces())
