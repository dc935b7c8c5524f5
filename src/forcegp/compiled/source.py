"""C++ and CUDA source code of a straight-line program, and its compiled kernel.

Kernels are compiled from C++ for a CPU, and by NVRTC for a GPU.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.compiled.expression import UNARY
from forcegp.compiled.program import Program
from forcegp.errors import MissingDependencyError
from forcegp.native import load_library

LANES_BYTES = 64
"""Vector width of a CPU kernel [bytes]. The compiler splits vectors if those of the machine are narrower."""
CUDA_THREADS = 128

_CPU = """\
#include <thread>
#include <vector>
typedef {type} T;
typedef T V __attribute__((vector_size({bytes})));
constexpr long W = {bytes} / sizeof(T);

static void block(const T* const* in, T* out, long valid) {{
  alignas({bytes}) T entry[{inputs}][W];
  alignas({bytes}) T result[{outputs}][W];
  for (long lane = 0; lane < W; ++lane) {{
    const long row = lane < valid ? lane : valid - 1;
{load}
  }}
{body}
  for (long lane = 0; lane < valid; ++lane)
    for (long k = 0; k < {outputs}; ++k) out[lane * {outputs} + k] = result[k][lane];
}}

static void range(const T* const* in, T* out, long begin, long end) {{
  for (long start = begin; start < end; start += W) {{
    const T* at[] = {{{shifted}}};
    block(at, out + start * {outputs}, end - start < W ? end - start : W);
  }}
}}

extern "C" void kernel(const T* const* in, T* out, long batch, long threads) {{
  const long share = ((batch + threads - 1) / threads + W - 1) / W * W;
  std::vector<std::thread> others;
  for (long begin = share; begin < batch; begin += share)
    others.emplace_back(range, in, out, begin, begin + share < batch ? begin + share : batch);
  range(in, out, 0, share < batch ? share : batch);
  for (std::thread& other : others) other.join();
}}
"""

_CUDA = """\
typedef {type} T;
typedef T V;

extern "C" __global__ void kernel({parameters}, T* out, int batch) {{
  const long long row = (long long)blockIdx.x * blockDim.x + threadIdx.x;
  if (row >= batch) return;
{body}
}}
"""


@dataclass(frozen=True)
class Source:
    """Source code, and the arrays that its kernel reads: arguments of the quantity, sin q and cos q."""

    text: str
    arrays: tuple[str, ...]


def statements(program: Program, load: dict[tuple[str, int], str], store: str) -> str:
    """Return one statement per live node, followed by stores, for vectors `V` of numbers `T`."""
    nodes, lines = program.graph.nodes, []
    name: dict[int, str] = {}
    for position in program.graph.live(program.outputs):
        op, left, right = nodes[position]
        if op == "const":
            # The compiler broadcasts scalar operands to all lanes; repr is exact to the last bit.
            name[position] = f"T({left!r})"
            continue
        name[position] = f"x{position}"
        if op == "input":
            value = load[left, right]  # pyright: ignore[reportArgumentType]
        else:
            value = _operation(op, *(name[x] for x in (left, right) if isinstance(x, int)))
        lines.append(f"  const V x{position} = {value};")
    for k, output in enumerate(program.outputs):
        lines.append("  " + store.format(k=k, value=f"V{{}} + {name[output.position]}"))
    return "\n".join(lines)


def _operation(op: str, left: str, right: str = "") -> str:
    """Return the source code of an operation. `step` and other functions exist only in C."""
    if op in UNARY:
        return f"{left} > 0.0" if op == "step" else f"{op}({left})"
    return f"{left} {op} {right}" if right else f"-{left}"


def inputs_of(program: Program) -> tuple[tuple[str, ...], list[tuple[str, int]]]:
    """Return the arrays that the program reads, and the entries that it uses."""
    nodes = (program.graph.nodes[i] for i in program.graph.live(program.outputs))
    entries = sorted((str(name), int(index)) for op, name, index in nodes if op == "input")  # pyright: ignore[reportArgumentType]
    return tuple(sorted({name for name, _ in entries})), entries


def _type(dtype: torch.dtype) -> str:
    return {torch.float64: "double", torch.float32: "float"}[dtype]


def cpu_source(program: Program, nq: int, dtype: torch.dtype) -> Source:
    """Return C++ code that computes a vector of samples at a time and distributes the batch over threads."""
    arrays, entries = inputs_of(program)
    load = "\n".join(
        f"    entry[{k}][lane] = in[{arrays.index(name)}][row * {nq} + {index}];"
        for k, (name, index) in enumerate(entries)
    )
    load_of = {entry: f"*(const V*)entry[{k}]" for k, entry in enumerate(entries)}
    text = _CPU.format(
        type=_type(dtype),
        bytes=LANES_BYTES,
        inputs=len(entries),
        outputs=len(program.outputs),
        load=load,
        body=statements(program, load_of, "*(V*)result[{k}] = {value};"),
        shifted=", ".join(f"in[{k}] + start * {nq}" for k in range(len(arrays))),
    )
    return Source(text, arrays)


STATEMENTS = 500
"""Maximum number of statements per C function, since compile time grows faster than linearly with it."""


def c_function(name: str, program: Program) -> str:
    """Return a static C99 function of one state, with parameters for arguments, sin q, cos q and result.

    A long program is split into several functions that pass intermediate values in an array.
    """
    names = (*program.arguments, "sin_q", "cos_q")
    entry = {"sin": "sin_q", "cos": "cos_q"}
    nodes, order = program.graph.nodes, program.graph.live(program.outputs)
    steps = [order[i : i + STATEMENTS] for i in range(0, len(order), STATEMENTS)]
    step_of = {position: i for i, step in enumerate(steps) for position in step}
    slot: dict[int, int] = {}
    for position in order:
        op, *operands = nodes[position]
        for x in operands if op not in ("const", "input") else ():
            if isinstance(x, int) and step_of[x] < step_of[position] and nodes[x][0] != "const":
                slot.setdefault(x, len(slot))
    stored: dict[int, list[int]] = {}
    for k, output in enumerate(program.outputs):
        stored.setdefault(output.position, []).append(k)
    arguments = ", ".join(f"const double *restrict {x}" for x in names)
    arguments += ", double *restrict kept, double *restrict out"
    texts = []
    for i, step in enumerate(steps):
        lines, named = list[str](), dict[int, str]()

        def value_of(position: int, lines: list[str] = lines, named: dict[int, str] = named) -> str:
            if position not in named:
                op, value, _ = nodes[position]
                named[position] = repr(value) if op == "const" else f"x{position}"
                if op != "const":
                    lines.append(f"  const double x{position} = kept[{slot[position]}];")
            return named[position]

        for position in step:
            op, left, right = nodes[position]
            if op != "const":
                if op == "input":
                    value = f"{entry.get(left, left)}[{right}]"  # pyright: ignore
                else:
                    value = _operation(op, *(value_of(x) for x in (left, right) if isinstance(x, int)))
                named[position] = f"x{position}"
                lines.append(f"  const double x{position} = {value};")
            lines += [f"  out[{k}] = {value_of(position)};" for k in stored.get(position, ())]
            lines += [f"  kept[{slot[position]}] = x{position};"] if position in slot else []
        unread = "".join(f"(void){x}, " for x in (*names, "kept"))
        code = "\n".join(lines)
        texts.append(f"static void {name}_{i}({arguments}) {{\n  {unread}(void)out;\n{code}\n}}\n")
    calls = ", ".join(f"{name}_{i}" for i in range(len(steps)))
    passed = ", ".join((*names, "kept", "out"))
    texts.append(
        f"static void {name}({arguments.replace(', double *restrict kept', '')}) {{\n"
        f"  static void (*const steps[])({arguments}) = {{{calls}}};\n  double kept[{len(slot) or 1}];\n"
        f"  for (int i = 0; i < {len(steps)}; ++i) steps[i]({passed});\n}}\n"
    )
    return "\n".join(texts)


def cuda_source(program: Program, nq: int, dtype: torch.dtype) -> Source:
    """Return CUDA C++ code that computes one sample per thread."""
    arrays, entries = inputs_of(program)
    load = {(name, index): f"in_{name}[row * {nq} + {index}]" for name, index in entries}
    text = _CUDA.format(
        type=_type(dtype),
        parameters=", ".join(f"const T* in_{name}" for name in arrays),
        body=statements(program, load, f"out[row * {len(program.outputs)} + {{k}}] = {{value}};"),
    )
    return Source(text, arrays)


Kernel = Callable[[Sequence[Tensor], Tensor], None]
"""A function that reads contiguous arrays `(B, nq)` and fills a contiguous result `(B, …)`."""

SAMPLES_PER_THREAD = 512
"""Minimum number of samples per thread, to amortise thread start-up."""


def cpu_kernel(text: str) -> Kernel:
    """Return the kernel compiled from `cpu_source` code. It runs on `torch.get_num_threads()` threads."""
    function = load_library(text).kernel
    function.restype = None
    function.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_long, ctypes.c_long]

    def run(arrays: Sequence[Tensor], out: Tensor) -> None:
        batch = out.shape[0]
        threads = max(1, min(torch.get_num_threads(), batch // SAMPLES_PER_THREAD))
        pointers = (ctypes.c_void_p * len(arrays))(*[x.data_ptr() for x in arrays])
        function(pointers, out.data_ptr(), batch, threads)

    return run


def cuda_kernel(text: str) -> Kernel:
    """Return the kernel that NVRTC compiles from `cuda_source` code.

    Raises:
        MissingDependencyError: the installed PyTorch cannot compile CUDA kernels at run time.
    """
    compile_kernel = getattr(torch.cuda, "_compile_kernel", None)
    if compile_kernel is None or not torch.cuda.is_available():
        raise MissingDependencyError(
            "the compiled dynamics cannot be built for CUDA here",
            expected="a CUDA device and PyTorch 2.9 or newer",
            got=f"PyTorch {torch.__version__}",
            hint="use forcegp.dynamics, which runs on CUDA as it is",
        )
    function = compile_kernel(text, "kernel")

    def run(arrays: Sequence[Tensor], out: Tensor) -> None:
        batch = out.shape[0]
        blocks = (batch + CUDA_THREADS - 1) // CUDA_THREADS
        with torch.cuda.device(out.device):
            function(grid=(blocks, 1, 1), block=(CUDA_THREADS, 1, 1), args=[*arrays, out, batch])

    return run
