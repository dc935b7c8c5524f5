"""C++ and CUDA source text of a straight-line program, and the kernel that it becomes.

Kernels are built from C++ on the CPU and by NVRTC on a GPU.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.compiled.program import Program
from forcegp.errors import MissingDependencyError
from forcegp.native import load_library

LANES_BYTES = 64
"""Width of the vectors of a CPU kernel; the compiler splits them where the machine's are narrower."""
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
    """Source text, and the arrays that its kernel reads: arguments of the quantity, "sin" or "cos" of q."""

    text: str
    arrays: tuple[str, ...]


def statements(program: Program, load: dict[tuple[str, int], str], store: str, vector: bool = True) -> str:
    """One statement a live node, then the stores, on vectors `V` of numbers `T` or, in C, on doubles."""
    nodes, lines = program.graph.nodes, []
    kind, lifted = ("V", "V{{}} + {}") if vector else ("double", "{}")
    name: dict[int, str] = {}
    for position in program.graph.live(program.outputs):
        op, left, right = nodes[position]
        if op == "const":
            # A scalar operand is spread over the lanes by the compiler; repr keeps every bit.
            name[position] = f"T({left!r})" if vector else repr(left)
            continue
        name[position] = f"x{position}"
        if op == "input":
            value = load[left, right]  # pyright: ignore[reportArgumentType]
        elif op == "neg":
            value = f"-{name[left]}"  # pyright: ignore[reportArgumentType]
        else:
            value = f"{name[left]} {op} {name[right]}"  # pyright: ignore[reportArgumentType]
        lines.append(f"  const {kind} x{position} = {value};")
    for k, output in enumerate(program.outputs):
        lines.append("  " + store.format(k=k, value=lifted.format(name[output.position])))
    return "\n".join(lines)


def inputs_of(program: Program) -> tuple[tuple[str, ...], list[tuple[str, int]]]:
    """The arrays that are read, and their entries that are used."""
    nodes = (program.graph.nodes[i] for i in program.graph.live(program.outputs))
    entries = sorted((str(name), int(index)) for op, name, index in nodes if op == "input")  # pyright: ignore[reportArgumentType]
    return tuple(sorted({name for name, _ in entries})), entries


def _type(dtype: torch.dtype) -> str:
    return {torch.float64: "double", torch.float32: "float"}[dtype]


def cpu_source(program: Program, nq: int, dtype: torch.dtype) -> Source:
    """C++ that computes a vector of samples at a time and shares the batch among threads."""
    arrays, entries = inputs_of(program)
    load = "\n".join(
        f"    entry[{k}][lane] = in[{arrays.index(name)}][row * {nq} + {index}];"
        for k, (name, index) in enumerate(entries)
    )
    text = _CPU.format(
        type=_type(dtype),
        bytes=LANES_BYTES,
        inputs=len(entries),
        outputs=len(program.outputs),
        load=load,
        body=statements(
            program,
            {entry: f"*(const V*)entry[{k}]" for k, entry in enumerate(entries)},
            "*(V*)result[{k}] = {value};",
        ),
        shifted=", ".join(f"in[{k}] + start * {nq}" for k in range(len(arrays))),
    )
    return Source(text, arrays)


def c_function(name: str, program: Program) -> str:
    """A static C99 function of one state: the arguments, sin q and cos q, then where the result goes."""
    names = (*program.arguments, "sin_q", "cos_q")
    entry = {"sin": "sin_q", "cos": "cos_q"}
    load = {(x, i): f"{entry.get(x, x)}[{i}]" for x, i in inputs_of(program)[1]}
    used = {entry.get(x, x) for x, _ in load}
    unread = "".join(f"  (void){x};\n" for x in names if x not in used)
    arguments = ", ".join(f"const double *restrict {x}" for x in names)
    body = statements(program, load, "out[{k}] = {value};", vector=False)
    return f"static void {name}({arguments}, double *restrict out) {{\n{unread}{body}\n}}\n"


def cuda_source(program: Program, nq: int, dtype: torch.dtype) -> Source:
    """CUDA C++ that computes one sample a thread."""
    arrays, entries = inputs_of(program)
    text = _CUDA.format(
        type=_type(dtype),
        parameters=", ".join(f"const T* in_{name}" for name in arrays),
        body=statements(
            program,
            {(name, index): f"in_{name}[row * {nq} + {index}]" for name, index in entries},
            f"out[row * {len(program.outputs)} + {{k}}] = {{value}};",
        ),
    )
    return Source(text, arrays)


Kernel = Callable[[Sequence[Tensor], Tensor], None]
"""Reads contiguous arrays `(B, nq)` and fills the contiguous result `(B, …)`."""

SAMPLES_PER_THREAD = 512
"""Minimum number of samples per thread, to amortise its start-up."""


def cpu_kernel(text: str) -> Kernel:
    """The kernel of a `cpu_source`, run on as many threads as `torch.get_num_threads()`."""
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
    """The kernel of a `cuda_source`, compiled by NVRTC.

    Raises:
        MissingDependencyError: this PyTorch cannot compile a CUDA kernel at run time.
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
