"""Load mutated robot files and report every one that does not end in a robot or in a typed error in time.

    python benchmarks/fuzz_robot_files.py --count 20000 --seed 0 --json fuzz.json

Each file is made from a bundled or an example file by a few random mutations; its number and the seed
reproduce it (`--only NUMBER` loads one of them and prints what happens). A child process does the
loading, so that a crash in native code is counted like any other failure.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import random
import re
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from ctypes import c_longlong
from importlib.util import find_spec
from pathlib import Path

import torch

import forcegp
from forcegp import dynamics
from forcegp.errors import ForceGPError

TIME_LIMIT = 2.0
NUMBERS = (
    b"nan", b"inf", b"-inf", b"-1", b"0", b"1e308", b"-1e308", b"1e-308", b"1e400", b"1e9", b"x", b"", b"1 2",
    b"0x1p3", b"1e12", b"-0", b"99999999999999999999",
)  # fmt: skip
SNIPPETS = (
    b'<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>', b"&b;", b"&#0;", b"<![CDATA[x]]>",
    b'<!DOCTYPE r SYSTEM "file:///etc/passwd">', b'<?xml version="1.0" encoding="utf-16"?>', b"<!--", b"-->",
    b'<include file="/etc/passwd"/>', b'<include file="robot.xml"/>', b'<replicate count="100000000">',
    b'<mimic joint="a"/>', b'<joint type="ball"/>', b"<freejoint/>", b"\x00", b"\xff\xfe", b"\xef\xbb\xbf",
    b'<body><joint/><geom size="1"/>', b"</body>", b'<plugin plugin="p"/>', b"<robot>", b"</robot>",
    b'<compiler inertiafromgeom="true" balanceinertia="true" settotalmass="-1"/>',
)  # fmt: skip
Mutation = Callable[[random.Random, bytes], bytes]


def _splice(pattern: bytes, replace: Callable[[random.Random, list[bytes], bytes], bytes]) -> Mutation:
    """A mutation of one random match of a pattern, given all matches."""

    def mutate(rng: random.Random, data: bytes) -> bytes:
        found = list(re.finditer(pattern, data))
        if not found:
            return data
        match = rng.choice(found)
        new = replace(rng, [m.group() for m in found], match.group())
        return data[: match.start()] + new + data[match.end() :]

    return mutate


def _flip(rng: random.Random, data: bytes) -> bytes:
    out = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        out[rng.randrange(len(out))] = rng.randrange(256)
    return bytes(out)


def _truncate(rng: random.Random, data: bytes) -> bytes:
    return data[: rng.randrange(len(data))]


def _move_chunk(rng: random.Random, data: bytes) -> bytes:
    start = rng.randrange(len(data))
    chunk = data[start : start + rng.randint(1, 600)]
    if rng.random() < 0.5:
        data = data[:start] + data[start + len(chunk) :]
    where = rng.randrange(len(data) + 1)
    return data[:where] + chunk * rng.choice((0, 1, 1, 2, 50)) + data[where:]


def _insert(rng: random.Random, data: bytes) -> bytes:
    at = rng.choice([m.end() for m in re.finditer(b">", data)] or [0])
    return data[:at] + rng.choice(SNIPPETS) + data[at:]


def _nest(rng: random.Random, data: bytes) -> bytes:
    depth = rng.choice((10, 100, 130, 5000))
    at = rng.choice([m.end() for m in re.finditer(b">", data)] or [0])
    return data[:at] + b"<body>" * depth + b"</body>" * depth + data[at:]


MUTATIONS: tuple[Mutation, ...] = (
    _flip,
    _truncate,
    _move_chunk,
    _insert,
    _nest,
    _splice(rb"<[^>]*>", lambda rng, found, one: b""),
    _splice(rb"<[^>]*>", lambda rng, found, one: one * 2),
    _splice(rb"<[^>]*>", lambda rng, found, one: rng.choice(found)),
    _splice(rb"-?\d[\d.eE+-]*", lambda rng, found, one: rng.choice(NUMBERS)),
    _splice(rb"-?\d[\d.eE+-]*", lambda rng, found, one: b"-" + one),
    _splice(rb"-?\d[\d.eE+-]*", lambda rng, found, one: rng.choice(found)),
    _splice(rb'"[^"]*"', lambda rng, found, one: rng.choice(found)),
    _splice(rb'"[^"]*"', lambda rng, found, one: b'""'),
    _splice(rb'\b[a-z_]+="', lambda rng, found, one: rng.choice(found)),
    _splice(rb'\b[a-z_]+="[^"]*"', lambda rng, found, one: b""),
    _splice(rb"<\w+", lambda rng, found, one: rng.choice(found)),
)


def seeds() -> list[bytes]:
    """The files to mutate: bundled ones, arms of example-robot-data if it is installed, and MJCF models."""
    here = Path(__file__).resolve().parents[1]
    paths = sorted((Path(forcegp.__file__).parent / "robot/bundled").glob("*.urdf")) * 4
    paths += [here / "tests/robot/data/branched.xml"] * 40
    spec = find_spec("cmeel")
    if spec is not None and spec.origin is not None:
        folder = Path(spec.origin).parents[1] / "cmeel.prefix/share/example-robot-data/robots"
        paths += [path for path in sorted(folder.glob("**/*.urdf")) if path.stat().st_size < 60_000]
    return [path.read_bytes() for path in paths if path.exists()]


def mutated(files: list[bytes], seed: int, number: int) -> bytes:
    """The file of a given number."""
    rng = random.Random(f"{seed}/{number}")
    data = rng.choice(files)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        data = rng.choice(MUTATIONS)(rng, data) or b" "
    return data


def load(path: Path) -> str:
    """Outcome of loading one file: a robot with finite dynamics, a typed error, or a failure."""
    start = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            robot = forcegp.load_robot(path)
        q = torch.full((robot.nq,), 0.3, dtype=robot.dtype)
        finite = bool(torch.isfinite(dynamics.mass_matrix(robot, q)).all())
        outcome = "robot" if finite else "failure: mass matrix is not finite"
    except ForceGPError as error:
        outcome = type(error).__name__ if str(path) in str(error) else f"failure: file not named: {error}"
    except Exception as error:
        outcome = f"failure: {type(error).__name__}: {error}"
    seconds = time.perf_counter() - start
    return f"failure: took {seconds:.1f} s" if seconds > TIME_LIMIT else outcome


def _work(files: list[bytes], seed: int, first: int, last: int, current: object, results: object) -> None:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.xml"
        for number in range(first, last):
            current.value = number  # type: ignore[attr-defined]
            path.write_bytes(mutated(files, seed, number))
            results.send((number, load(path)))  # type: ignore[attr-defined]


def fuzz(count: int, seed: int) -> tuple[Counter[str], list[tuple[int, str]]]:
    """Outcomes of `count` files, and the failures by number."""
    files, outcomes, failures = seeds(), Counter[str](), []
    current, number = multiprocessing.Value(c_longlong, 0), 0
    while number < count:
        receive, send = multiprocessing.Pipe(duplex=False)
        worker = multiprocessing.Process(target=_work, args=(files, seed, number, count, current, send))
        worker.start()
        send.close()
        while number < count:
            outcome = "failure: hangs" if not receive.poll(10 * TIME_LIMIT) else ""
            try:
                number, outcome = (current.value, outcome) if outcome else receive.recv()
            except EOFError:
                worker.join()
                number, outcome = current.value, f"failure: process ended with {worker.exitcode}"
            outcomes["failure" if outcome.startswith("failure") else outcome] += 1
            if outcome.startswith("failure"):
                failures.append((number, outcome))
            number += 1
            if "hangs" in outcome or "process ended" in outcome:
                break
        worker.kill()
        worker.join()
    return outcomes, failures


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="load one file and print it and its outcome")
    parser.add_argument("--json", type=Path, help="write the outcomes to this file")
    options = parser.parse_args()
    if options.only is not None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.xml"
            path.write_bytes(mutated(seeds(), options.seed, options.only))
            print(path.read_bytes().decode(errors="replace"), load(path), sep="\n")
        return
    start = time.perf_counter()
    outcomes, failures = fuzz(options.count, options.seed)
    result = {
        "count": options.count,
        "seed": options.seed,
        "seconds": round(time.perf_counter() - start, 1),
        "outcomes": dict(outcomes),
        "failures": failures,
    }
    if options.json:
        options.json.write_text(json.dumps(result, indent=1))
    print(json.dumps(result, indent=1))
    raise SystemExit(bool(failures))


if __name__ == "__main__":
    main()
