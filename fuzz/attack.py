"""Feed every reader mutated files, and report each that does not end in an answer.

    python fuzz/attack.py --inputs 20000                  every target, by coverage where atheris is installed
    python fuzz/attack.py --inputs 20000 --engine mutate  by random mutation alone
    python fuzz/attack.py --target csv --input FILE         one input, with its traceback

A finding is a raw exception, a crash, more than 5 s, or more than 1 GiB; it is written to
`fuzz/corpora/<target>/`, where every later run, and the test suite, tries it first.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import os
import random
import resource
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
SECONDS, MEMORY = 5.0, 1 << 30


def options() -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--inputs", type=int, default=20_000, help="per target")
    parser.add_argument(
        "--first", type=int, default=0, help="number of the first random input, to go on there"
    )
    parser.add_argument("--target", action="append", help="only this one; may be repeated")
    parser.add_argument("--engine", choices=("auto", "atheris", "mutate"), default="auto")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--input", type=Path, help="run this file alone")
    parser.add_argument("--worker", choices=("atheris", "mutate"), help=argparse.SUPPRESS)
    return parser.parse_args()


def mutate(target: str, first: int, inputs: int, seed: int) -> None:
    """Run a target on random mutations; a file `current` beside tells a crash's input."""
    import faulthandler

    from mutate import mutated
    from targets import CORPORA, run_one, seeds

    corpus, current = seeds(target), CORPORA / target / ".current"
    for data in corpus:
        run_one(target, data)
    memory, answers = peak(), dict[str, int]()
    for number in range(first, first + inputs):
        data = mutated(random.Random(f"{seed}-{number}"), corpus)
        current.write_bytes(data)
        faulthandler.dump_traceback_later(SECONDS, exit=True)
        answer = run_one(target, data)
        faulthandler.cancel_dump_traceback_later()
        answers[answer] = answers.get(answer, 0) + 1
        if peak() - memory > MEMORY:
            sys.exit(f"{target}: {(peak() - memory) >> 20} MiB for one input")
        memory = max(memory, peak())
    current.unlink(missing_ok=True)
    print(f"[attack] {target}: {inputs} inputs, {answers}", flush=True)


def peak() -> int:
    """Largest memory of the process so far [bytes]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def guided(target: str, first: int, inputs: int, seed: int) -> None:
    """Run a target on inputs that atheris finds by coverage."""
    import atheris

    with atheris.instrument_imports(include=["forcegp"]):
        from targets import CORPORA, run_one

    found = HERE.parent / "out" / "fuzz" / target
    found.mkdir(parents=True, exist_ok=True)
    flags = (
        f"-runs={inputs}", f"-seed={seed + first + 1}", f"-timeout={int(SECONDS)}", "-rss_limit_mb=2048",
        "-max_len=100000", "-detect_leaks=0", "-verbosity=0", f"-artifact_prefix={CORPORA / target}/finding-",
    )  # fmt: skip
    atheris.Setup(
        [sys.argv[0], *flags, str(found), str(CORPORA / target)], lambda data: run_one(target, data)
    )
    atheris.Fuzz()


def one_target(target: str, engine: str, first: int, inputs: int, seed: int) -> bool:
    """Run one target in a process of its own; whether it ended without a finding."""
    command = [sys.executable, str(Path(__file__)), "--worker", engine, "--target", target]
    command += ["--first", str(first), "--inputs", str(inputs), "--seed", str(seed)]
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    took = f"{time.perf_counter() - start:.0f} s"
    if done.returncode == 0:
        print(f"[attack] {target}: {engine}, {inputs} inputs, no finding, {took}", flush=True)
        sys.stdout.write(
            "".join(line + "\n" for line in done.stdout.splitlines() if line.startswith("[attack]"))
        )
        return True
    current = HERE / "corpora" / target / ".current"
    if current.exists():
        data = current.read_bytes()
        current.rename(current.with_name(f"finding-{hashlib.sha256(data).hexdigest()[:12]}"))
    print(
        f"[attack] {target}: FINDING after {took}\n{done.stderr[:1500]} … {done.stderr[-1500:]}", flush=True
    )
    return False


def main() -> int:
    """Attack what was asked for; the number of targets with a finding."""
    asked = options()
    if asked.worker:
        run = {"mutate": mutate, "atheris": guided}[asked.worker]
        run(asked.target[0], asked.first, asked.inputs, asked.seed)
        return 0
    if asked.input:
        from targets import run_one

        print(run_one(asked.target[0], asked.input.read_bytes()))
        return 0
    engine = asked.engine
    if engine == "auto":
        engine = "atheris" if importlib.util.find_spec("atheris") else "mutate"
    names = asked.target or sorted(p.name for p in (HERE / "corpora").iterdir() if p.is_dir())
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    return sum(not one_target(name, engine, asked.first, asked.inputs, asked.seed) for name in names)


if __name__ == "__main__":
    sys.exit(main())
