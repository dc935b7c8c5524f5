"""Small files that unpack to gigabytes end in a typed error, within 1 GiB of memory and 5 s."""

from __future__ import annotations

import bz2
import io
import json
import sqlite3
import struct
import subprocess
import sys
import zipfile
import zlib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

h5py = pytest.importorskip("h5py")
pytest.importorskip("mcap")
pytest.importorskip("rosbags")

MIB = 1 << 20
SECONDS, MEMORY = 5.0, 1024
"""Bounds of SECURITY.md [s, MiB]."""
JOINT_STATE = "sensor_msgs/msg/JointState"


def packed(compressor: Any, size: int, unit: bytes = bytes(MIB)) -> bytes:
    """So many copies of a block, compressed."""
    return b"".join(compressor.compress(unit) for _ in range(size)) + compressor.flush()


@cache
def deflated() -> bytes:
    """1.1 GiB of zeros."""
    return packed(zlib.compressobj(1), 1126)


def mcap(path: Path, chunk: bytes, compression: str, kind: str, index: bool = False) -> None:
    """A file with one chunk, which says that it is small."""
    from mcap import records
    from mcap.data_stream import RecordBuilder

    file, magic = RecordBuilder(), bytes([137, 77, 67, 65, 80, 48, 13, 10])
    file.write(magic)
    records.Header("ros2", "test").write(file)
    listed = (
        records.Schema(id=1, data=b"", encoding="ros2msg", name=kind),
        records.Channel(id=1, topic="/j", message_encoding="cdr", metadata={}, schema_id=1),
    )
    for record in listed:
        record.write(file)
    start, times = file.count, {"message_start_time": 0, "message_end_time": 1}
    head = {"compression": compression, "uncompressed_size": 1100 * MIB} | times
    records.Chunk(data=chunk, uncompressed_crc=0, **head).write(file)
    records.DataEnd(0).write(file)
    summary = file.count if index else 0
    for record in listed if index else ():
        record.write(file)
    if index:
        sizes = {"chunk_length": len(chunk) + 80, "compressed_size": len(chunk)}
        place = {"chunk_start_offset": start, "message_index_length": 0, "message_index_offsets": {}}
        records.ChunkIndex(**head, **sizes, **place).write(file)
    records.Footer(summary, 0, 0).write(file)
    file.write(magic)
    path.write_bytes(file.end())


def mcaps(folder: Path) -> None:
    """Zeros, and messages without content, of a topic that is read and of another one."""
    import lz4.frame
    import zstandard
    from mcap import records
    from mcap.data_stream import RecordBuilder

    def zstd(size: int, unit: bytes) -> bytes:
        return packed(zstandard.ZstdCompressor(level=3).compressobj(), size, unit)

    builder = RecordBuilder()
    records.Message(channel_id=1, log_time=0, data=b"", publish_time=0, sequence=0).write(builder)
    messages = builder.end() * (1 << 15)
    mcap(folder / "zeros.mcap", zstd(1100, bytes(MIB)), "zstd", JOINT_STATE)
    mcap(folder / "zeros-indexed.mcap", zstd(1100, bytes(MIB)), "zstd", JOINT_STATE, index=True)
    mcap(folder / "messages.mcap", zstd(200, messages), "zstd", JOINT_STATE)
    mcap(folder / "few-messages.mcap", zstd(15, messages), "zstd", "std_msgs/msg/String")
    mcap(folder / "lz4.mcap", lz4.frame.compress(bytes(256 * MIB)), "lz4", JOINT_STATE)


def bag(path: Path, chunk: bytes, compression: bytes) -> None:
    """A bag of ROS 1 with one chunk and one message."""

    def header(**fields: bytes) -> bytes:
        parts = (name.encode() + b"=" + value for name, value in fields.items())
        text = b"".join(struct.pack("<I", len(part)) + part for part in parts)
        return struct.pack("<I", len(text)) + text

    def record(data: bytes, **fields: bytes) -> bytes:
        return header(**fields) + struct.pack("<I", len(data)) + data

    one, zero, stamp = struct.pack("<I", 1), struct.pack("<I", 0), bytes(8)
    start = len(b"#ROSBAG V2.0\n") + 4096
    body = record(chunk, op=b"\x05", compression=compression, size=one)
    body += record(bytes(12), op=b"\x04", ver=one, conn=zero, count=one)
    head = header(op=b"\x03", index_pos=struct.pack("<Q", start + len(body)), conn_count=one, chunk_count=one)
    about = header(topic=b"/j", type=b"sensor_msgs/JointState", md5sum=b"x", message_definition=b"")[4:]
    place = struct.pack("<Q", start)
    times = {"start_time": stamp, "end_time": stamp}
    path.write_bytes(
        b"#ROSBAG V2.0\n" + head + struct.pack("<I", 4092 - len(head)) + b" " * (4092 - len(head)) + body
        + record(about, op=b"\x07", conn=zero, topic=b"/j")
        + record(bytes(4) + one, op=b"\x06", ver=one, chunk_pos=place, count=one, **times)
    )  # fmt: skip


def bags(folder: Path) -> None:
    """ROS 1 with both compressions; ROS 2 with a computed column, and with one topic listed often."""
    import lz4.frame

    bag(folder / "bz2.bag", packed(bz2.BZ2Compressor(1), 1100), b"bz2")
    bag(folder / "lz4.bag", lz4.frame.compress(bytes(256 * MIB)), b"lz4")
    columns = "name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT"
    computed = "data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL"
    for name, data, topics in (("computed.db3", computed, 1), ("joined.db3", "data BLOB", 20_000)):
        with sqlite3.connect(folder / name) as base:
            base.execute(f"CREATE TABLE topics(id INTEGER, {columns})")
            base.execute(f"CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER, {data})")
            rows = [(1, "/j", JOINT_STATE, "cdr", "")] * topics
            base.executemany("INSERT INTO topics VALUES(?, ?, ?, ?, ?)", rows)
            stamps = [(1, k) for k in range(topics)]
            base.executemany("INSERT INTO messages(topic_id, timestamp) VALUES(?, ?)", stamps)
        base.close()


def hdf5s(folder: Path) -> None:
    """A chunk that is large, one that inflates beyond its size, and one that is deflated twice."""
    with h5py.File(folder / "large.h5", "w") as file:
        data = file.create_dataset("q", (2,), "i1", maxshape=(None,), chunks=(1 << 31,), compression="gzip")
        data.id.write_direct_chunk((0,), deflated())
    with h5py.File(folder / "grows.h5", "w") as file:
        data = file.create_dataset("q", (1000,), chunks=(1000,), dtype="f8", compression="gzip")
        data.id.write_direct_chunk((0,), deflated())
    with h5py.File(folder / "twice.h5", "w") as file:
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_chunk((1000,))
        properties.set_deflate(9)
        properties.set_deflate(9)
        space = h5py.h5s.create_simple((1000,))
        data = h5py.h5d.create(file.id, b"q", h5py.h5t.IEEE_F64LE, space, properties)
        data.write_direct_chunk((0,), zlib.compress(deflated(), 9))


def others(folder: Path) -> None:
    """MATLAB with many small integers, Parquet with long lists, NumPy with an array of the largest size."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    import scipy.io

    arrays = {f"a{i}": np.zeros(100 * MIB, np.int8) for i in range(6)}
    scipy.io.savemat(folder / "many.mat", arrays, do_compression=True)
    scipy.io.savemat(folder / "one.mat", {"a": np.zeros(120 * MIB, np.int8)}, do_compression=True)
    lists = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(4000 * 8000)), 4000)
    pq.write_table(pa.table({"q": lists}), folder / "lists.parquet", compression="zstd")
    with zipfile.ZipFile(folder / "bytes.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        header = io.BytesIO()
        form = {"descr": "|i1", "fortran_order": False, "shape": (120 * MIB,)}
        np.lib.format.write_array_header_1_0(header, form)
        with archive.open("a.npy", "w") as file:
            file.write(header.getvalue())
            for _ in range(120):
                file.write(bytes(MIB))


READ = """
import json, resource, sys, time
import h5py, mcap.reader, pyarrow.parquet, rosbags.rosbag1, rosbags.rosbag2, scipy.io, torch
from pathlib import Path
from forcegp.errors import ForceGPError
from forcegp.logs.readers import read
from forcegp.logs.readers.bags import JOINT_STATE, decoder

decoder(JOINT_STATE, "cdr"), decoder(JOINT_STATE, "ros1")
resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
found = {}
for path in sorted(Path(sys.argv[1]).iterdir()):
    peak, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    try:
        read(path)
        answer = "read"
    except ForceGPError as error:
        answer = type(error).__name__
    except BaseException as error:
        answer = repr(error)
    more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak
    found[path.name] = answer, time.perf_counter() - start, more >> 10
print(json.dumps(found))
"""


@pytest.mark.slow
def test_bombs_are_refused_within_the_promised_bounds(tmp_path: Path) -> None:
    for make in (mcaps, bags, hdf5s, others):
        make(tmp_path)
    files = {path.name: path.stat().st_size for path in tmp_path.iterdir()}
    assert len(files) == 16 and max(files.values()) < 6 * MIB
    command = [sys.executable, "-c", READ, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert found.keys() == files.keys()
    wrong = {
        name: answer
        for name, answer in found.items()
        if answer[0] != "DataError" or not (answer[1] < SECONDS and answer[2] < MEMORY)
    }
    assert not wrong, wrong
