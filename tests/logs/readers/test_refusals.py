"""Hostile and damaged files: typed errors, and no code of theirs is run."""

from __future__ import annotations

import contextlib
import io
import json
import pickle
import sqlite3
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from forcegp import limits
from forcegp.errors import DataError, MissingDependencyError
from forcegp.logs.readers import read
from log_files import WRITERS, motion


class Trap:
    """Leaves a mark when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return Path.touch, (self.mark,)  # type: ignore[return-value]


@pytest.mark.parametrize("name", ["run.pkl", "run.pt", "run.bin", "run.npy", "run.npz", "run.mat"])
def test_pickles_are_refused_and_not_run(tmp_path: Path, name: str) -> None:
    mark, path = tmp_path / "mark", tmp_path / name
    trap = np.array([Trap(mark)], dtype=object)
    if name.endswith(".npy"):
        np.save(path, trap, allow_pickle=True)
    elif name.endswith(".npz"):
        np.savez(path, q=trap)
    elif name.endswith(".pt"):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("archive/data.pkl", pickle.dumps(Trap(mark)))
    else:
        path.write_bytes(pickle.dumps(Trap(mark)))
    with pytest.raises(DataError, match=r"refused|damaged|unsupported log format"):
        read(path)
    assert not mark.exists()


def test_a_renamed_pytorch_file_is_recognised(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "run.npz", "w") as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02.")
    with pytest.raises(DataError, match="PyTorch"):
        read(tmp_path / "run.npz")


@pytest.mark.parametrize("kind", WRITERS)
def test_truncated_and_garbled_files_end_in_a_typed_error_or_are_read(kind: str, tmp_path: Path) -> None:
    path, _ = WRITERS[kind](tmp_path, motion(40))
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    random = np.random.default_rng(0)
    for file in files:
        whole = file.read_bytes()
        for k in range(12):
            content = bytearray(whole)
            if k % 2:
                content = content[: int(random.integers(1, len(whole)))]
            else:
                for place in random.integers(0, len(whole), 8):
                    content[place] = int(random.integers(0, 256))
            file.write_bytes(bytes(content))
            with contextlib.suppress(DataError):
                read(path)
        file.write_bytes(whole)


def test_an_archive_that_unpacks_to_more_than_the_limit(tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)}
    )
    with zipfile.ZipFile(tmp_path / "run.npz", "w") as archive:
        archive.writestr("q.npy", header.getvalue())
    with pytest.raises(DataError, match="too many numbers"):
        read(tmp_path / "run.npz")


def test_a_small_parquet_file_with_a_huge_list(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    n = limits.COLUMNS + 1
    pq.write_table(pa.table({"q": pa.array([[0.0] * n] * 3)}), tmp_path / "run.parquet")
    with pytest.raises(DataError, match="too many columns"):
        read(tmp_path / "run.parquet")
    ragged = pa.table({"q": pa.array([[0.0, 1.0], [2.0]])})
    pq.write_table(ragged, tmp_path / "ragged.parquet")
    with pytest.raises(DataError, match=r"lists of different length(?s:.*)row 1"):
        read(tmp_path / "ragged.parquet")


def test_a_wide_array_is_refused_before_its_columns_are_made(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", q=np.zeros((5000, limits.COLUMNS + 1), np.int8))
    with pytest.raises(DataError, match="too many columns"):
        read(tmp_path / "run.npz")


def test_links_out_of_an_hdf5_file_are_not_followed(tmp_path: Path) -> None:
    import h5py

    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["q"] = np.arange(9.0)
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["t"] = np.arange(5.0)
        file["link"] = h5py.ExternalLink("secret.h5", "/q")
        file["soft"] = h5py.SoftLink("/t")
        file["loop"] = file["/"]
    table = read(tmp_path / "run.h5")
    assert table.names == ["t"] and sum("not followed" in remark for remark in table.remarks) == 2


def test_bags_without_joint_states_say_what_they_hold(tmp_path: Path) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(tmp_path / "run.bag") as bag:
        topic = bag.add_connection("/chatter", "std_msgs/msg/String", typestore=store)
        text = store.types["std_msgs/msg/String"](data="hello")
        bag.write(topic, 1, store.serialize_ros1(text, "std_msgs/msg/String"))
    with pytest.raises(DataError, match=r"(?s)JointState.*/chatter \(std_msgs/msg/String\)"):
        read(tmp_path / "run.bag")
    sqlite3.connect(tmp_path / "other.db3").execute("create table a(b)").connection.commit()
    with pytest.raises(DataError, match="damaged"):
        read(tmp_path / "other.db3")


def test_compressed_bags_of_unknown_size_are_refused(tmp_path: Path) -> None:
    path, _ = WRITERS["rosbag 2"](tmp_path, motion(20))
    meta = path / "metadata.yaml"
    text = meta.read_text()
    meta.write_text(
        text.replace("compression_mode: ''", "compression_mode: FILE").replace(
            "compression_mode: none", "compression_mode: FILE"
        )
    )
    assert "FILE" in meta.read_text()
    with pytest.raises(DataError, match="compressed"):
        read(path)


@pytest.mark.parametrize(
    ("kind", "inside"),
    [
        ("lerobot", "data/chunk-000/file-000.parquet"),
        ("lerobot", "meta/info.json"),
        ("lerobot", "meta"),
        ("text folder", "pos.txt"),
        ("rosbag 2", "run2.db3"),
    ],
)
def test_links_out_of_a_folder_are_refused(kind: str, inside: str, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    path, _ = WRITERS[kind](tmp_path / "in", motion(20))
    read(path)
    (path / inside).rename(tmp_path / "elsewhere")
    (path / inside).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DataError, match=r"link to a path outside (?s:.*)cp -rL"):
        read(path)


def test_a_ros_2_bag_of_mcap_files_is_read_like_the_files(tmp_path: Path) -> None:
    file, _ = WRITERS["mcap"](tmp_path, motion(20))
    alone = read(file).streams[0].columns
    (tmp_path / "bag").mkdir()
    file.rename(tmp_path / "bag" / "run_0.mcap")
    (tmp_path / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: 9\n")
    together = read(tmp_path / "bag").streams[0].columns
    assert all(np.array_equal(together[name], values) for name, values in alone.items())


def test_a_lerobot_folder_whose_description_is_damaged(tmp_path: Path) -> None:
    path, _ = WRITERS["lerobot"](tmp_path, motion(20))
    (path / "meta" / "info.json").write_text(json.dumps([1]))
    with pytest.raises(DataError, match="not the description"):
        read(path)


def test_a_missing_reader_is_named_with_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, _ = WRITERS["hdf5"](tmp_path, motion(20))
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingDependencyError, match=r"'h5py'(?s:.*)forcegp\[import\]"):
        read(path)


@pytest.mark.parametrize("name", ["run.xyz", "run.zip"])
def test_formats_that_are_not_read(tmp_path: Path, name: str) -> None:
    if name.endswith("zip"):
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            archive.writestr("a.txt", "1")
    else:
        (tmp_path / name).write_bytes(b"abc")
    with pytest.raises(DataError, match="unsupported log format"):
        read(tmp_path / name)
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="unsupported log format"):
        read(tmp_path / "empty")


def test_data_of_another_hdf5_file_are_left_out(tmp_path: Path) -> None:
    """A virtual data set shows numbers of a file that its author chose on the reader's disk."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "private.h5", "w") as file:
        file["q"] = np.arange(20.0)
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["t"] = np.arange(20.0)
        layout = h5py.VirtualLayout((20,), "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "private.h5"), "q", (20,))
        file.create_virtual_dataset("virtual", layout)
        file["link"] = h5py.ExternalLink(str(tmp_path / "private.h5"), "/q")
    table = read(tmp_path / "log.h5")
    assert [name for stream in table.streams for name in stream.columns] == ["t"]
    assert any("'virtual' lies outside the file" in remark for remark in table.remarks)


def test_small_files_that_claim_gigabytes_are_refused(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "bomb.h5", "w") as file:
        file.create_dataset("q", (1 << 27,), dtype="f8", chunks=(1 << 20,), compression="gzip")
    np.savez_compressed(tmp_path / "bomb.npz", q=np.zeros(20 << 20))
    for name in ("bomb.h5", "bomb.npz"):
        with pytest.raises(DataError, match="declared size of the file exceeds the limit"):
            read(tmp_path / name)
