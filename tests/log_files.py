"""One motion of the bundled double pendulum, written in every log format by the format's own library."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

REAL = Path(__file__).parents[1].parent / "shared" / "real"
"""Real logs that are not part of the repository."""
JOINTS = ("shoulder", "elbow")

real_logs = pytest.mark.skipif(not REAL.is_dir(), reason=f"the real logs are not at {REAL}")


@dataclass(frozen=True)
class Motion:
    """A smooth motion at 100 Hz, `(n,)` and `(n, 2)`."""

    t: NDArray[np.float64]
    q: NDArray[np.float64]
    qd: NDArray[np.float64]
    tau: NDArray[np.float64]


def motion(n: int = 300, dt: float = 0.01) -> Motion:
    """The motion; its numbers have many digits, so that a format that rounds them is found out."""
    t = np.arange(n) * dt
    phase = np.array([0.3, 1.1])
    rate = np.array([2.0, 3.0])
    x = t[:, None] * rate + phase
    return Motion(t, np.sin(x), rate * np.cos(x), 5.0 * np.cos(x) + np.sin(3.0 * x))


def mapping(
    time: str = "t",
    position: str = "q_{joint}",
    velocity: str = "qd_{joint}",
    torque: str = "tau_{joint}",
    joints: dict[str, str] | None = None,
) -> str:
    """A mapping in SI units."""
    names = "".join(f'{joint} = "{name}"\n' for joint, name in (joints or {}).items())
    return (
        f'[time]\ncolumn = "{time}"\n\n[joints]\n{names}\n'
        f'[position]\ncolumn = "{position}"\nunit = "rad"\n'
        f'[velocity]\ncolumn = "{velocity}"\nunit = "rad/s"\n'
        f'[torque]\ncolumn = "{torque}"\nunit = "Nm"\n'
    )


def table(m: Motion) -> dict[str, NDArray[np.float64]]:
    """The motion as named columns."""
    named = (("q", m.q), ("qd", m.qd), ("tau", m.tau))
    return {"t": m.t} | {f"{n}_{joint}": x[:, i] for n, x in named for i, joint in enumerate(JOINTS)}


def write_csv(folder: Path, m: Motion) -> tuple[Path, str]:
    columns = table(m)
    lines = [
        ",".join(columns),
        *(",".join(map(repr, map(float, row))) for row in zip(*columns.values(), strict=True)),
    ]
    (folder / "run.csv").write_text("\n".join(lines) + "\n")
    return folder / "run.csv", mapping()


def write_folder(folder: Path, m: Motion) -> tuple[Path, str]:
    """Text files with one quantity each, separated by runs of blanks, with blanks at the line ends."""
    place = folder / "run"
    place.mkdir()
    for name, values in (("time", m.t[:, None]), ("pos", m.q), ("vel", m.qd), ("trq", m.tau)):
        lines = ["  " + "   ".join(repr(float(x)) for x in row) + " " for row in values]
        (place / f"{name}.txt").write_text("\n".join(lines) + "\n")
    names = {"shoulder": "0", "elbow": "1"}
    return place, mapping("time[0]", "pos[{joint}]", "vel[{joint}]", "trq[{joint}]", names)


def write_parquet(folder: Path, m: Motion) -> tuple[Path, str]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table(table(m)), folder / "run.parquet")
    return folder / "run.parquet", mapping()


INDEXED = {"shoulder": "0", "elbow": "1"}
MATRICES = mapping("t", "q[{joint}]", "qd[{joint}]", "tau[{joint}]", INDEXED)


def write_npz(folder: Path, m: Motion) -> tuple[Path, str]:
    np.savez_compressed(folder / "run.npz", t=m.t, q=m.q, qd=m.qd, tau=np.asfortranarray(m.tau))
    return folder / "run.npz", MATRICES


def write_matlab5(folder: Path, m: Motion) -> tuple[Path, str]:
    from scipy.io import savemat

    log = {"t": m.t[:, None], "q": m.q, "qd": m.qd.T, "tau": m.tau}
    savemat(folder / "run.mat", {"log": log, "note": "text", "cells": np.array(["a", 1], object)})
    names = ("log.t", "log.q[{joint}]", "log.qd[{joint}]", "log.tau[{joint}]")
    return folder / "run.mat", mapping(*names, INDEXED)


def write_matlab73(folder: Path, m: Motion) -> tuple[Path, str]:
    """As MATLAB does: a header of 512 bytes, axes in the reverse order."""
    import h5py

    path = folder / "run73.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("t", m.t[:, None]), ("q", m.q), ("qd", m.qd), ("tau", m.tau)):
            file.create_dataset(name, data=values.T).attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path, MATRICES


def write_hdf5(folder: Path, m: Motion) -> tuple[Path, str]:
    import h5py

    with h5py.File(folder / "run.h5", "w") as file:
        group = file.create_group("robot")
        file["t"] = m.t
        for name, values in (("q", m.q), ("qd", m.qd), ("tau", m.tau)):
            group.create_dataset(name, data=values, compression="gzip")
        file["images"] = np.zeros((3, 4, 5))
        file["elsewhere"] = h5py.ExternalLink("/etc/passwd", "/")
    names = ("t", "robot/q[{joint}]", "robot/qd[{joint}]", "robot/tau[{joint}]")
    return folder / "run.h5", mapping(*names, INDEXED)


ROS = mapping("header", "position.{joint}", "velocity.{joint}", "effort.{joint}")


def joint_states(m: Motion, store: object, ros1: bool) -> list[tuple[int, object]]:
    """Messages with the joints in an order that changes, as a publisher may send them."""
    types = store.types  # type: ignore[attr-defined]
    Time, Header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    State = types["sensor_msgs/msg/JointState"]
    messages = []
    for k, (t, *rows) in enumerate(zip(m.t, m.q, m.qd, m.tau, strict=True)):
        order = [0, 1] if k % 3 else [1, 0]
        ns = 1_700_000_000_000_000_000 + round(1e9 * float(t))
        stamp = Time(sec=ns // 10**9, nanosec=ns % 10**9)
        header = Header(seq=k, stamp=stamp, frame_id="") if ros1 else Header(stamp=stamp, frame_id="")
        values = [np.ascontiguousarray(row[order]) for row in rows]
        names = [JOINTS[i] for i in order]
        state = State(header=header, name=names, position=values[0], velocity=values[1], effort=values[2])
        messages.append((ns + 1500, state))
    return messages


def write_rosbag1(folder: Path, m: Motion) -> tuple[Path, str]:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS1_NOETIC), "sensor_msgs/msg/JointState"
    with Writer(folder / "run.bag") as bag:
        topic = bag.add_connection("/joint_states", kind, typestore=store)
        for ns, message in joint_states(m, store, ros1=True):
            bag.write(topic, ns, store.serialize_ros1(message, kind))
    return folder / "run.bag", ROS


def write_rosbag2(folder: Path, m: Motion) -> tuple[Path, str]:
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS2_HUMBLE), "sensor_msgs/msg/JointState"
    with Writer(folder / "run2", version=9) as bag:
        topic = bag.add_connection("/joint_states", kind, typestore=store)
        for ns, message in joint_states(m, store, ros1=False):
            bag.write(topic, ns, store.serialize_cdr(message, kind))
    return folder / "run2", ROS


def joint_state_bag(folder: Path, m: Motion, late: bool) -> Path:
    """A ROS 2 bag without velocities. Either the first 20 messages lack efforts, or a gripper comes first."""
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS2_HUMBLE), "sensor_msgs/msg/JointState"
    types, empty = store.types, np.zeros(0)
    gripper = types[kind](
        header=types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](sec=1_699_999_999, nanosec=0), frame_id=""
        ),
        name=["finger"], position=np.ones(1), velocity=np.zeros(1), effort=np.zeros(1),
    )  # fmt: skip
    with Writer(folder / "bag", version=9) as bag:
        topic = bag.add_connection("/joint_states", kind, typestore=store)
        if not late:
            bag.write(topic, 1_699_999_999_000_000_000, store.serialize_cdr(gripper, kind))
        for k, (ns, message) in enumerate(joint_states(m, store, ros1=False)):
            message.velocity = empty  # type: ignore[attr-defined]
            if late and k < 20:
                message.effort = empty  # type: ignore[attr-defined]
            bag.write(topic, ns, store.serialize_cdr(message, kind))
    return folder / "bag"


def write_bare_db3(folder: Path, m: Motion) -> tuple[Path, str]:
    bag, toml = write_rosbag2(folder, m)
    (bag / "metadata.yaml").unlink()
    return next(bag.glob("*.db3")), toml


def write_mcap(folder: Path, m: Motion) -> tuple[Path, str]:
    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS2_HUMBLE), "sensor_msgs/msg/JointState"
    with (folder / "run.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(name=kind, encoding="ros2msg", data=b"")
        channel = writer.register_channel(topic="/joint_states", message_encoding="cdr", schema_id=schema)
        for ns, message in joint_states(m, store, ros1=False):
            data = bytes(store.serialize_cdr(message, kind))
            writer.add_message(channel_id=channel, log_time=ns, publish_time=ns, data=data)
        writer.finish()
    return folder / "run.mcap", ROS


def write_lerobot(folder: Path, m: Motion) -> tuple[Path, str]:
    """Version 3: two episodes in one file, whose clocks start at zero."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    place = folder / "lerobot"
    (place / "meta").mkdir(parents=True)
    (place / "data" / "chunk-000").mkdir(parents=True)
    names = [f"{joint}.pos" for joint in JOINTS]
    features = {"observation.state": {"dtype": "float64", "shape": [2], "names": names}}
    features |= {
        name: {"dtype": "float64", "shape": [2], "names": None}
        for name in ("observation.velocity", "observation.effort")
    }
    (place / "meta" / "info.json").write_text(json.dumps({"codebase_version": "v3.0", "features": features}))
    half = len(m.t) // 2
    columns = {
        "observation.state": pa.FixedSizeListArray.from_arrays(pa.array(m.q.ravel()), 2),
        "observation.velocity": pa.array(list(m.qd)),
        "observation.effort": pa.array(list(m.tau)),
        "timestamp": np.concatenate([m.t[:half], m.t[: len(m.t) - half]]),
        "episode_index": (np.arange(len(m.t)) >= half).astype(np.int64),
        "task": ["wipe"] * len(m.t),
    }
    pq.write_table(pa.table(columns), place / "data" / "chunk-000" / "file-000.parquet")
    toml = mapping("timestamp", "", "observation.velocity[{joint}]", "observation.effort[{joint}]", INDEXED)
    toml = toml.replace('column = "timestamp"', 'column = "timestamp"\nsegment = "episode_index"')
    columns_ = ", ".join(f'{joint} = "observation.state.{joint}.pos"' for joint in JOINTS)
    return place, toml.replace('column = ""', f"columns = {{ {columns_} }}")


WRITERS: dict[str, Callable[[Path, Motion], tuple[Path, str]]] = {
    "csv": write_csv,
    "text folder": write_folder,
    "parquet": write_parquet,
    "npz": write_npz,
    "matlab 5": write_matlab5,
    "matlab 7.3": write_matlab73,
    "hdf5": write_hdf5,
    "rosbag 1": write_rosbag1,
    "rosbag 2": write_rosbag2,
    "bare db3": write_bare_db3,
    "mcap": write_mcap,
    "lerobot": write_lerobot,
}
"""Format → a function that writes the motion, and gives the path and a mapping."""
