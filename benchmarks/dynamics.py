"""Speed of the dynamics beside Pinocchio, MuJoCo, frax, adam-robotics and differentiable-robot-model.

    python benchmarks/dynamics.py --json result.json --docs benchmarks/notes/speed.md

Times are the best of several repetitions of one batch, float64, all in this process on the same machine.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from dynamics_peers import Adam, Call, DifferentiableRobotModel, Frax, Mujoco, Pinocchio, torch_call
from results_page import write_section
from torch import Tensor

import forcegp
from forcegp import derivatives, dynamics
from forcegp.compiled import compile_dynamics

BATCHES = (1, 256, 4096, 65536)
QUANTITIES = {
    "forward_dynamics": "forward dynamics",
    "mass_matrix": "mass matrix",
    "constraint_terms": "M, Q_C, Q_G, A, b, L, T, H of one contact",
    "gradient": "gradient of the forward dynamics (autograd: one backward pass)",
    "jacobians": "all Jacobians ∂q̈/∂(q, q̇, τ) in closed form",
}
FRAME, POINT = "lbr_iiwa_link_7", (0.0, 0.0, 0.1)
PACKAGES = ("torch", "pin", "mujoco", "frax", "jax", "adam-robotics", "differentiable-robot-model")
SECONDS_PER_CELL = 1.5
"""Time spent on each entry of the table, beyond one warming-up call."""
LONGEST_CALL = 2.0
"""An entry is left out where one call on the batch before, sixteen times smaller, took longer [s]."""

Prepare = Callable[..., Call | None]


def ours(robot: forcegp.RobotModel) -> dict[str, Prepare]:
    """This library, eager and compiled, on the CPU and on CUDA if there is a device."""
    table = {"forcegp": eager_on(robot), "forcegp compiled": compiled_on(robot)}
    if torch.cuda.is_available():
        moved = robot.to("cuda")
        table |= {"forcegp on CUDA": eager_on(moved), "forcegp compiled on CUDA": compiled_on(moved)}
    return table


def eager_on(robot: forcegp.RobotModel) -> Prepare:
    contact = forcegp.SurfaceContact(
        name="table", frame=FRAME, point=POINT, surface=forcegp.Plane(normal=(0.0, 0.0, 1.0), offset=0.0)
    )
    system = forcegp.ConstrainedSystem(robot, [contact])

    def terms(q: Tensor, qd: Tensor) -> None:
        eom = system.equations(q, qd)
        _ = eom.L, eom.T, eom.H

    def prepare(quantity: str, *states: Tensor) -> Call | None:
        states = tuple(x.to(robot.device) for x in states)
        calls = {
            "constraint_terms": lambda: terms(*states[:2]),
            "jacobians": lambda: derivatives.forward_dynamics_derivatives(robot, *states) and None,
        }
        return calls.get(quantity) or torch_call(
            quantity,
            lambda q: dynamics.mass_matrix(robot, q),
            lambda *x: dynamics.forward_dynamics(robot, *x),
            *states,
        )

    return prepare


def compiled_on(robot: forcegp.RobotModel) -> Prepare:
    compiled = {
        name: compile_dynamics(robot, name)
        for name in ("forward_dynamics", "mass_matrix", "forward_dynamics_derivatives")
    }

    def prepare(quantity: str, *states: Tensor) -> Call | None:
        states = tuple(x.to(robot.device) for x in states)
        if quantity == "jacobians":
            return lambda: compiled["forward_dynamics_derivatives"](*states).shape and None
        return torch_call(quantity, compiled["mass_matrix"], compiled["forward_dynamics"], *states)

    return prepare


def peers(robot: forcegp.RobotModel, urdf: Path) -> dict[str, Prepare]:
    """The other libraries that are installed."""
    makers: dict[str, Callable[[], dict[str, Prepare]]] = {
        "pin": lambda: _pinocchio(urdf),
        "mujoco": lambda: {"MuJoCo (loop)": Mujoco(urdf).prepare},
        "frax": lambda: {"frax on CUDA" if torch.cuda.is_available() else "frax": Frax(urdf).prepare},
        "adam-robotics": lambda: {"adam-robotics": Adam(urdf, robot.joint_names).prepare},
        "differentiable-robot-model": lambda: {
            "differentiable-robot-model": DifferentiableRobotModel(urdf).prepare
        },
    }
    table: dict[str, Prepare] = {}
    for package, make in makers.items():
        if versions()[package] is None:
            print(f"{package} is not installed and left out (pip install 'forcegp[benchmark,test]')")
        else:
            table |= make()
    return table


def _pinocchio(urdf: Path) -> dict[str, Prepare]:
    pinocchio = Pinocchio(urdf, FRAME, POINT, torch.get_num_threads())

    def loop(quantity: str, *states: Tensor) -> Call | None:
        # Its derivatives are all Jacobians at once; autograd's backward pass has no counterpart.
        return None if quantity == "gradient" else pinocchio.loop(_PINOCCHIO.get(quantity, quantity), *states)

    return {"Pinocchio (loop)": loop, "Pinocchio (threads)": pinocchio.threaded}


_PINOCCHIO = {"jacobians": "gradient"}


def versions() -> dict[str, str | None]:
    """Installed versions of the packages that are compared."""
    found: dict[str, str | None] = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    return found


def seconds(call: Call) -> float:
    """Best time of one call, over `SECONDS_PER_CELL`."""
    on_cuda = torch.cuda.is_available()
    best, end = float("inf"), time.perf_counter() + SECONDS_PER_CELL
    while time.perf_counter() < end or best == float("inf"):
        start = time.perf_counter()
        call()
        if on_cuda:
            torch.cuda.synchronize()
        best = min(best, time.perf_counter() - start)
    return best


def measure(robot: forcegp.RobotModel, table: dict[str, Prepare], batches: tuple[int, ...]) -> list[dict]:
    """One row an implementation, quantity and batch, with the largest relative difference to ours."""
    generator, rows = torch.Generator().manual_seed(0), []
    before: dict[tuple[str, str], float] = {}
    for batch in batches:
        states = tuple(torch.randn(batch, robot.nq, dtype=robot.dtype, generator=generator) for _ in range(3))
        for quantity in QUANTITIES:
            reference = None
            for name, prepare in table.items():
                call = prepare(quantity, *states)
                if call is None or before.get((quantity, name), 0.0) > LONGEST_CALL:
                    continue
                result, error = call(), None
                if quantity in ("forward_dynamics", "mass_matrix"):
                    value = result.cpu() if isinstance(result, Tensor) else torch.from_numpy(np.array(result))
                    reference = value if reference is None else reference
                    error = float((value - reference).abs().max() / reference.abs().max())
                took = seconds(call)
                before[quantity, name] = took
                rows.append({
                    "quantity": quantity, "implementation": name, "batch": batch, "seconds": took,
                    "per_second": batch / took, "difference": error,
                })  # fmt: skip
                print(f"{batch:6d} {quantity:17s} {name:27s} {batch / took:12.0f} /s", flush=True)
    return rows


def _peak(name: str, batch: int, queue: multiprocessing.Queue) -> None:
    """Growth of the peak resident memory [bytes] while one batch is computed, in a process of its own."""
    robot = forcegp.load_robot("kuka_iiwa")
    compiled = compile_dynamics(robot) if name == "compiled" else None
    small, states = torch.ones(3, 2, robot.nq, dtype=robot.dtype), torch.ones(3, batch, robot.nq).double()
    run = {
        "forward dynamics": lambda x: dynamics.forward_dynamics(robot, *x),
        "compiled": lambda x: compiled(*x),
        "jacobians": lambda x: derivatives.forward_dynamics_derivatives(robot, *x),
        "gradient": lambda x: torch.autograd.grad(
            dynamics.forward_dynamics(robot, *(y := x.clone().requires_grad_())).sum(), y
        ),
    }[name]
    run(small)
    # Writing 5 sets the high-water mark back to what is resident now (Linux, proc(5)).
    Path("/proc/self/clear_refs").write_text("5")
    before = _high_water()
    run(states)
    queue.put(_high_water() - before)


def _high_water() -> int:
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def memory(batch: int) -> dict[str, int]:
    """Peak memory [bytes] that a batch takes, by what is computed; none where the system does not tell."""
    if not Path("/proc/self/clear_refs").exists():
        return {}
    context, table = multiprocessing.get_context("spawn"), {}
    for name in ("forward dynamics", "compiled", "jacobians", "gradient"):
        queue = context.Queue()
        process = context.Process(target=_peak, args=(name, batch, queue))
        process.start()
        table[name] = queue.get()
        process.join()
    return table


def machine() -> dict[str, object]:
    """What the figures were measured on."""
    cpu = platform.processor()
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        cpu = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), cpu)
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "python": platform.python_version(),
        "packages": versions(),
    }


def markdown(result: dict) -> str:
    """The section of the documentation: one table a quantity, in thousands of states a second."""
    host = result["machine"]
    packages = ", ".join(f"{name} {v}" for name, v in host["packages"].items() if v)
    lines = [
        "## Dynamics on CUDA" if host["cuda"] else "## Dynamics",
        "",
        f"KUKA iiwa, 7 joints, float64, {host['cpu']}, {host['threads']} threads"
        + (f", {host['cuda']}" if host["cuda"] else ", no CUDA device")
        + f"; {packages}. Thousands of states a second, best of several runs;",
        "`python benchmarks/dynamics.py --json FILE --docs benchmarks/notes/speed.md` measures them again.",
    ]
    for quantity, title in QUANTITIES.items():
        rows = [row for row in result["rows"] if row["quantity"] == quantity]
        batches = sorted({row["batch"] for row in rows})
        lines += ["", f"**{title[0].upper()}{title[1:]}**", ""]
        lines += ["| batch | " + " | ".join(map(str, batches)) + " |", "|---" * (len(batches) + 1) + "|"]
        for name in dict.fromkeys(row["implementation"] for row in rows):
            speed = {row["batch"]: row["per_second"] for row in rows if row["implementation"] == name}
            cells = (f"{speed[b] / 1e3:,.1f}" if b in speed else "–" for b in batches)
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    lines += ["", f"Peak memory of a batch of {result['memory_batch']}: "]
    lines[-1] += ", ".join(f"{k} {v / 2**20:,.0f} MiB" for k, v in result["memory"].items()) + "."
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    parser.add_argument("--docs", type=Path, help="write the tables into this Markdown file")
    parser.add_argument("--batches", type=int, nargs="+", default=BATCHES)
    options = parser.parse_args()
    urdf = Path(str(files("forcegp.robot") / "bundled" / "kuka_iiwa.urdf"))
    robot = forcegp.load_robot("kuka_iiwa")
    table = ours(robot) | peers(robot, urdf)
    largest = min(max(options.batches), BATCHES[-1])
    result = {
        "machine": machine(),
        "rows": measure(robot, table, tuple(options.batches)),
        "memory_batch": largest,
        "memory": memory(largest),
    }
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    if options.docs:
        section = "dynamics on CUDA" if result["machine"]["cuda"] else "dynamics"
        write_section(options.docs, section, markdown(result))
    print(markdown(result))


if __name__ == "__main__":
    main()
