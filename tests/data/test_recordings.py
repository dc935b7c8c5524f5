"""Recordings keep their names and numbers in files, selections, concatenations and streams."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import forcegp
from forcegp.checks import read_log
from forcegp.data.fields import UNKNOWN, recording_number
from forcegp.errors import DataError, MappingError
from forcegp.logs import import_log, parse_mapping
from log_files import motion, write_csv

ROBOT = forcegp.load_robot("double_pendulum")


def imported(folder: Path, shift: float = 0.0) -> forcegp.Dataset:
    """A log in a new folder, with positions moved by `shift`."""
    folder.mkdir()
    path, toml = write_csv(folder, replace(motion(), q=motion().q + shift))
    return import_log(path, ROBOT, parse_mapping(toml.encode(), "m.toml")).data


def test_an_imported_log_is_a_recording_named_by_its_file_and_hash(tmp_path: Path) -> None:
    data = imported(tmp_path / "a")
    ((name, log),) = data.header.recordings.items()
    assert data.recordings == (name,) and name == f"run-{log[:6]}" and len(log) > 6
    data.write(tmp_path / "a.parquet")
    again = forcegp.Dataset.read(tmp_path / "a.parquet")
    assert again.recordings == (name,) and again.header.recordings == data.header.recordings
    assert bool((again.recording == recording_number(name)).all())


def test_files_with_one_name_are_two_recordings(tmp_path: Path) -> None:
    first, second = imported(tmp_path / "a"), imported(tmp_path / "b", 0.1)
    both = forcegp.Dataset.concatenate([first, second])
    assert both.recordings == (*first.recordings, *second.recordings) and len(set(both.recordings)) == 2
    same = forcegp.Dataset.concatenate([first[:50], first[80:], imported(tmp_path / "c")])
    assert same.recordings == first.recordings


def test_two_logs_with_one_given_name_are_refused_and_renamed(tmp_path: Path) -> None:
    first, second = imported(tmp_path / "a").named("run"), imported(tmp_path / "b", 0.1).named("run")
    with pytest.raises(DataError, match="two recordings are named 'run'") as raised:
        forcegp.Dataset.concatenate([first, second])
    assert raised.value.hint is not None and "named" in raised.value.hint
    both = forcegp.Dataset.concatenate([first, second.named("later")])
    assert both.recordings == ("run", "later")
    assert both[both.recording == recording_number("later")].recordings == ("later",)


def test_observations_of_two_logs_with_one_name_are_refused(tmp_path: Path) -> None:
    logs = [imported(tmp_path / name, shift).named("run") for name, shift in (("a", 0.0), ("b", 0.1))]
    model = forcegp.StructuredGP(forcegp.ConstrainedSystem(ROBOT))
    with pytest.raises(DataError, match="two recordings are named 'run'"):
        model.fit([forcegp.priors.Observation(log) for log in logs])


def test_a_column_numbers_the_recordings_of_a_log(tmp_path: Path) -> None:
    path, toml = write_csv(tmp_path, motion())
    lines = path.read_text().splitlines()
    rows = [f"{line},{7 if k < 120 else 9}" for k, line in enumerate(lines[1:])]
    path.write_text("\n".join([f"{lines[0]},take", *rows]) + "\n")
    mapped = toml.replace('column = "t"\n', 'column = "t"\nrecording = "take"\n', 1)
    data = import_log(path, ROBOT, parse_mapping(mapped.encode(), "m.toml")).data
    (log,) = set(data.header.recordings.values())
    assert data.recordings == (f"run-{log[:6]} 7", f"run-{log[:6]} 9")
    change = int(np.flatnonzero(data.recording.diff().numpy())[0]) + 1
    assert float(data.t[change]) == pytest.approx(1.2) and bool(data.segment.diff()[change - 1])
    path.write_text(path.read_text().replace(",7\n", ",7.5\n"))
    with pytest.raises(DataError, match="'take' does not number recordings in row 0"):
        import_log(path, ROBOT, parse_mapping(mapped.encode(), "m.toml"))
    with pytest.raises(MappingError, match="recordings"):
        parse_mapping(mapped.replace("recording =", "recordings =").encode(), "m.toml")


def test_a_table_without_header_names_recordings_by_their_numbers(tmp_path: Path) -> None:
    t, zero = torch.arange(6, dtype=torch.float64), torch.zeros(6, 1, dtype=torch.float64)
    plain = forcegp.Dataset(t, zero, zero, zero, zero, ("joint",))
    assert plain.recordings == () and bool((plain.recording == UNKNOWN).all())
    numbered = plain.replace(recording=torch.tensor([3, 3, 3, 12, 12, UNKNOWN]))
    assert numbered.recordings == ("3", "12")
    lines = ["t,q.joint,qd.joint,qdd.joint,tau.joint,recording", *(f"{k},0,0,0,0,{k // 3}" for k in range(6))]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    assert forcegp.Dataset.read(tmp_path / "log.csv").recordings == ("0", "1")
    (tmp_path / "log.csv").write_text("\n".join([*lines[:-1], "5,0,0,0,0,0.5"]) + "\n")
    with pytest.raises(DataError, match="'recording' is not a recording number in row 5"):
        forcegp.Dataset.read(tmp_path / "log.csv")
    with pytest.raises(DataError, match="needs a name"):
        plain.named("")
    with pytest.raises(DataError, match="'recording' has the wrong type"):
        plain.replace(recording=torch.zeros(6))


def test_a_table_with_recordings_is_checked(tmp_path: Path) -> None:
    imported(tmp_path / "a").write(tmp_path / "a.parquet")
    assert read_log(tmp_path / "a.parquet").joint_names == ROBOT.joint_names


def test_streams_keep_recordings(tmp_path: Path) -> None:
    for name in ("a", "b"):
        imported(tmp_path / name).named(name).write(tmp_path / f"{name}.parquet")
    stream = forcegp.StreamedDataset([tmp_path / "a.parquet", tmp_path / "b.parquet"])
    whole = forcegp.Dataset.concatenate([*stream.pieces()])
    assert whole.recordings == ("a", "b")
    imported(tmp_path / "c", 0.1).named("a").write(tmp_path / "c.parquet")
    with pytest.raises(DataError, match="two recordings are named 'a'"):
        forcegp.StreamedDataset([tmp_path / "a.parquet", tmp_path / "c.parquet"]).header  # noqa: B018
