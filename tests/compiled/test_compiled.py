"""Compiled dynamics: the figures and derivatives of the eager functions, the cache, and the errors."""

from __future__ import annotations

import ctypes
import subprocess
import time
from pathlib import Path

import pytest
import torch
from torch.func import jacfwd, jacrev, vmap

import forcegp
from forcegp import derivatives, dynamics, native
from forcegp.compiled import compile_dynamics
from forcegp.compiled.program import QUANTITIES, trace
from forcegp.compiled.source import cuda_source
from forcegp.errors import MissingDependencyError, ModelError, ShapeError, UnknownNameError
from forcegp.native import find_compiler
from forcegp.robot.model import RobotModel
from random_robots import random_robot
from robots import random_states
from test_dynamics import relative

SAME = 1e-12  # of the largest entry: the same sums in another order
FIRST_BUILD, LATER_START = 60.0, 5.0  # seconds
SEVERAL = 1100  # samples: a vector not filled, and more than one thread where there are two


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory):
    """An empty cache of our own."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("kernels")
        patch.setenv("FORCEGP_CACHE", str(folder))
        yield folder


def states_of(robot: RobotModel, quantity: str, count: int) -> list[torch.Tensor]:
    q, qd, qdd, force = random_states(robot, count)
    table = {"q": q, "qd": qd, "qdd": qdd, "force": force}
    return [table[name] for name in QUANTITIES[quantity][0]]


def eager(robot: RobotModel, quantity: str, states: list[torch.Tensor]) -> torch.Tensor:
    if quantity == "forward_dynamics_derivatives":
        return torch.stack(derivatives.forward_dynamics_derivatives(robot, *states), dim=-3)
    return getattr(dynamics, quantity)(robot, *states)


def tolerance(robot: RobotModel, states: list[torch.Tensor]) -> float:
    """Rounding, and what M⁻¹ makes of it."""
    condition = float(torch.linalg.cond(dynamics.mass_matrix(robot, states[0])).max())
    return max(SAME, 4.0 * torch.finfo(robot.dtype).eps * condition)


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("name", ["kuka_iiwa", "random0"])
def test_figures_of_the_eager_functions(name: str, quantity: str) -> None:
    robot = forcegp.load_robot(name) if name == "kuka_iiwa" else random_robot(int(name[-1]))
    start = time.perf_counter()
    compiled = compile_dynamics(robot, quantity)
    assert time.perf_counter() - start < FIRST_BUILD
    for count in (1, SEVERAL):
        states = states_of(robot, quantity, count)
        ours = compiled(*states)
        assert relative(ours, eager(robot, quantity, states)) < tolerance(robot, states)
        assert torch.equal(compiled(*[x[-1] for x in states]), ours[-1])
    assert compiled(*[x[:0] for x in states]).shape == ours[:0].shape
    pairs = [x[:6].reshape(2, 3, -1) for x in states]
    assert torch.equal(compiled(*pairs).flatten(0, 1), compiled(*[x[:6] for x in states]))


def test_single_precision() -> None:
    robot = random_robot(2).to(dtype=torch.float32)
    states = [x.float() for x in states_of(robot, "inverse_dynamics", SEVERAL)]
    ours = compile_dynamics(robot, "inverse_dynamics")(*states)
    assert ours.dtype == torch.float32
    assert relative(ours, eager(robot, "inverse_dynamics", states)) < 1e-4  # 2⁻²³ over some hundred sums


@pytest.mark.parametrize("quantity", ["forward_dynamics", "mass_matrix"])
def test_derivatives(quantity: str) -> None:
    robot = random_robot(3, nq=3)
    compiled = compile_dynamics(robot, quantity)
    states = [x.requires_grad_() for x in states_of(robot, quantity, 2)]
    assert torch.autograd.gradcheck(compiled, states, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(compiled, states)
    fixed = [x.detach() for x in states]
    expected = vmap(jacrev(lambda *x: eager(robot, quantity, list(x))))(*fixed)
    for transform in (jacrev, jacfwd):
        torch.testing.assert_close(vmap(transform(compiled))(*fixed), expected, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(vmap(compiled)(*fixed), compiled(*fixed))


@pytest.mark.slow
def test_gradients_in_large_batches_are_the_eager_ones() -> None:
    robot = random_robot(4)
    states = [x.requires_grad_() for x in states_of(robot, "forward_dynamics", SEVERAL)]
    weight = torch.randn(SEVERAL, robot.nq, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    compiled = compile_dynamics(robot)
    ours = torch.autograd.grad((compiled(*states) * weight).sum(), states)
    theirs = torch.autograd.grad((eager(robot, "forward_dynamics", states) * weight).sum(), states)
    for x, y in zip(ours, theirs, strict=True):
        assert relative(x, y) < max(1e-10, tolerance(robot, [x.detach() for x in states]))


def test_the_cache_spares_the_compiler(monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    robot = random_robot(5)
    first = compile_dynamics(robot, "gravity_force")
    kept = set(cache.iterdir())

    def version_only(command: list[str], **options: object):
        assert command[1:] == ["--version"], "the compiler ran again"
        return run(command, **options)

    run = subprocess.run
    monkeypatch.setattr(subprocess, "run", version_only)
    start = time.perf_counter()
    again = compile_dynamics(robot, "gravity_force")
    assert time.perf_counter() - start < LATER_START
    assert set(cache.iterdir()) == kept
    q = random_states(robot, 3)[0]
    assert torch.equal(first(q), again(q))


def test_robots_that_differ_do_not_share_a_kernel() -> None:
    robot = random_robot(6)
    heavier = robot.replace(mass=2.0 * robot.mass)
    q = random_states(robot, 3)[0]
    ours = compile_dynamics(heavier, "gravity_force")(q)
    torch.testing.assert_close(ours, 2.0 * compile_dynamics(robot, "gravity_force")(q))


def test_no_compiler_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    with pytest.raises(MissingDependencyError, match=r"need a C\+\+ compiler(.|\n)*expected: c\+\+ or g\+\+"):
        compile_dynamics(random_robot(7))


def test_a_failing_compiler_says_why(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, cache: Path) -> None:
    compiler = tmp_path / "broken"
    compiler.write_text("#!/bin/sh\necho no space left >&2\nexit 1\n")
    compiler.chmod(0o700)
    monkeypatch.setenv("CXX", str(compiler))
    before = set(cache.iterdir())
    with pytest.raises(MissingDependencyError, match=r"could not build the kernel(.|\n)*no space left"):
        compile_dynamics(random_robot(7))
    assert set(cache.iterdir()) == before


def test_a_compiler_that_is_no_program_is_one_clear_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "text").write_text("no program")
    (tmp_path / "text").chmod(0o700)
    monkeypatch.setenv("CXX", str(tmp_path / "text"))
    with pytest.raises(MissingDependencyError, match=r"cannot be used(.|\n)*set CXX"):
        compile_dynamics(random_robot(7))


def test_a_user_without_a_home_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(native, "cache_directory", no_home)
    with pytest.raises(MissingDependencyError, match=r"home directory(.|\n)*FORCEGP_CACHE"):
        compile_dynamics(random_robot(7))


def test_a_cache_that_cannot_be_written_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    monkeypatch.setenv("FORCEGP_CACHE", str(file / "kernels"))
    with pytest.raises(MissingDependencyError, match=r"cannot be written to (.|\n)*set FORCEGP_CACHE"):
        compile_dynamics(random_robot(7), "gravity_force")


def test_what_cannot_be_compiled_is_refused() -> None:
    robot = random_robot(0)
    with pytest.raises(UnknownNameError, match=r"'mas_matrix'(.|\n)*did you mean 'mass_matrix'"):
        compile_dynamics(robot, "mas_matrix")
    with pytest.raises(ModelError, match=r"require a gradient(.|\n)*got: mass"):
        compile_dynamics(robot.replace(mass=robot.mass.clone().requires_grad_()))
    with pytest.raises(ModelError, match=r"precision(.|\n)*got: torch.float16"):
        compile_dynamics(robot.to(dtype=torch.float16))
    compiled = compile_dynamics(robot, "gravity_force")
    q = torch.zeros(4, robot.nq, dtype=torch.float64)
    with pytest.raises(ShapeError, match=r"takes 1 arguments(.|\n)*expected: q"):
        compiled(q, q)
    with pytest.raises(ShapeError, match="q has the wrong shape"):
        compiled(q[:, :2])


CUDA_ON_CPU = """
struct Index { unsigned x; };
static thread_local Index blockIdx, blockDim, threadIdx;
#define __global__ static
%s
extern "C" void launch(const double* const* in, double* out, long batch) {
  blockDim.x = 4;
  for (unsigned b = 0; b * 4 < batch; ++b)
    for (unsigned t = 0; t < 4; ++t) { blockIdx.x = b; threadIdx.x = t; kernel(%s, out, batch); }
}
"""


def test_the_cuda_source_computes_the_same(tmp_path: Path) -> None:
    """The CUDA text, with CUDA's index variables emulated, as there may be no GPU to run it on."""
    robot = random_robot(1)
    source = cuda_source(trace(robot, "forward_dynamics"), robot.nq, robot.dtype)
    arguments = ", ".join(f"in[{k}]" for k in range(len(source.arrays)))
    text = CUDA_ON_CPU % (source.text.replace('extern "C" ', ""), arguments)
    library = tmp_path / "emulated.so"
    command = [find_compiler(), "-O1", "-shared", "-fPIC", "-x", "c++", "-", "-o", str(library)]
    subprocess.run(command, input=text, text=True, check=True)
    states = states_of(robot, "forward_dynamics", 7)
    given = dict(zip(("q", "qd", "force"), states, strict=True))
    given |= {"sin": torch.sin(given["q"]), "cos": torch.cos(given["q"])}
    arrays = [given[name] for name in source.arrays]
    out = torch.empty_like(states[0])
    pointers = (ctypes.c_void_p * len(arrays))(*[x.data_ptr() for x in arrays])
    ctypes.CDLL(str(library)).launch(pointers, ctypes.c_void_p(out.data_ptr()), ctypes.c_long(7))
    assert relative(out, eager(robot, "forward_dynamics", states)) < tolerance(robot, states)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_cuda(quantity: str) -> None:
    robot = forcegp.load_robot("kuka_iiwa")
    states = states_of(robot, quantity, SEVERAL)
    on_gpu = robot.to("cuda")
    moved = [x.cuda() for x in states]
    expected = eager(robot, quantity, states)
    assert relative(eager(on_gpu, quantity, moved).cpu(), expected) < tolerance(robot, states)
    assert relative(compile_dynamics(on_gpu, quantity)(*moved).cpu(), expected) < tolerance(robot, states)
