"""The folder of an exported model: C code with a test program and CMakeLists.txt, or a CasADi function."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from forcegp.data import Dataset
from forcegp.data.fields import DataHeader
from forcegp.destination import check_folder, folder_or_keep
from forcegp.errors import ParameterError, check_name
from forcegp.forces.measurements import Training
from forcegp.forces.posterior import HIGH, LOW
from forcegp.models.export.casadi_function import write_casadi
from forcegp.models.export.library import CompiledFit
from forcegp.models.export.model import ExportedModel
from forcegp.models.export.source import READ, c_source, template
from forcegp.models.external_wrench import LearnedForces, contact_force, external_wrench
from forcegp.models.prediction import Prediction, Predictor

LANGUAGES = ("c", "casadi")
STATES, LOSS_STATES = 16, 200
"""Number of states in the test program; number of states at which the loss of a reduction is measured."""
TOLERANCE, ZERO = 1e-10, 1e-5
"""Largest difference from Python, relative to max(|mean|, σ), or to `ZERO` times its maximum at a state."""


@dataclass(frozen=True)
class Export:
    """The files of an export, and their errors.

    Attributes:
        folder: the path of the folder.
        functions: number of basis functions in the covariance.
        widest, wider: largest and median relative growth of σ of q̈ and λ caused by a reduced-rank
            covariance. They are measured at training states or, if a saved fit has none, at random states.
        rounding: largest errors caused by single precision at these states. The first is the error of the
            means of q̈ and λ in units of max(|mean|, σ). The second is the relative error of σ. Both are zero
            in double precision.
        loss: what the reduced-rank covariance loses, in words; empty if it is not reduced.
    """

    folder: Path
    functions: int
    widest: float = 0.0
    wider: float = 0.0
    rounding: tuple[float, float] = (0.0, 0.0)
    loss: str = ""


def write_export(
    model: ExportedModel, fit: Predictor, training: Training, path: str | Path, language: str, name: str
) -> Export:
    """Write a model to a folder. The arguments and errors are those of `StructuredFit.export`."""
    check_name("language of an export", language, LANGUAGES)
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,40}", name):
        raise ParameterError(
            f"{name!r} cannot be the prefix of C functions",
            expected="lower-case letters, digits and underscores, a letter first",
        )
    check_folder(path)
    if language == "casadi":
        write_casadi(model, Path(path), name)
        return Export(Path(path), model.parts()[0].rank)
    model = model.reduced()
    header, source = c_source(model, name)
    exact = dataclasses.replace(model, dtype=torch.float64)
    growth, rank = loss_of(exact, fit, training), model.parts()[0].rank
    where = "training" if training.samples else "random"
    loss = f"It keeps {rank} of {model.size} functions: at {where} states, σ of q̈ and λ increases\n"
    loss += f"by a fraction of at most {growth[0]:.2g} (median: {growth[1]:.2g}). The mean is unchanged."
    loss = "" if model.functions is None else loss
    result = Export(Path(path), rank, *growth, rounding_of(model, training), loss)
    in_mean, in_std = result.rounding
    rounding = f"Single precision: at {where} states, the mean of q̈ and λ errs by at most {in_mean:.2g} "
    rounding += f"of max(|mean|, σ),\nand σ by at most a fraction of {in_std:.2g}."
    coarse = model.dtype == torch.float32
    fields = {
        "real": "float" if coarse else "double",
        "rounding": rounding if coarse else "",
        "name": name,
        "NAME": name.upper(),
        "robot": model.system.robot.name,
        "functions": result.functions,
        "loss": loss,
        "tables": _reference(model, fit, name),
    }
    texts = {f"{name}.h": header, f"{name}.c": source, f"test_{name}.c": template("test.c", fields)}
    texts |= {file: template(f"{file}.in", fields) for file in ("CMakeLists.txt", "README.md")}

    def fill(folder: Path) -> None:
        for file, text in texts.items():
            (folder / file).write_text(text, encoding="utf-8")

    folder_or_keep(fill, path)
    return result


def rounding_of(model: ExportedModel, training: Training) -> tuple[float, float]:
    """Return the errors of the means and σ of q̈ and λ caused by single precision (see `Export.rounding`).

    Raises:
        NumericalError: single precision cannot resolve a variance.
    """
    if model.dtype == torch.float64:
        return 0.0, 0.0
    *states, active = states_of(model, training)
    coarse, fine = (
        CompiledFit(x).predict(*states, ["qdd", "multiplier"], active=active)  # pyright: ignore
        for x in (model, dataclasses.replace(model, dtype=torch.float64))
    )
    assert coarse.std is not None and fine.std is not None
    size = fine.mean.abs().maximum(fine.std)
    size = size.maximum(ZERO * size.nan_to_num().amax(-1, keepdim=True))
    in_mean = ((coarse.mean - fine.mean).abs() / size)[~size.isnan()]
    in_std = (coarse.std / fine.std - 1.0).abs()[fine.std > ZERO * fine.std.nan_to_num().amax()]
    return float(in_mean.max()), float(in_std.max())


def loss_of(model: ExportedModel, fit: Predictor, training: Training) -> tuple[float, float]:
    """Return the largest and median growth of σ of q̈ and λ caused by a reduced-rank covariance."""
    if model.functions is None:
        return 0.0, 0.0
    states = states_of(model, training)
    read = [
        x.predict(*states[:3], ["qdd", "multiplier"], active=states[3])  # pyright: ignore
        for x in (CompiledFit(model), fit)
    ]
    small, whole = (x.covariance.diagonal(dim1=-2, dim2=-1).sqrt() for x in read if x.covariance is not None)
    # Structural zeros, such as λ of an open contact, have no error bars that could grow.
    growth = (small / whole - 1.0)[whole > ZERO * whole.nan_to_num().amax()]
    return float(growth.max()), float(growth.median())


def states_of(model: ExportedModel, training: Training) -> tuple[Tensor, ...]:
    """Return q, q̇, τ and closed contacts at training states, or at random states if none were kept."""
    if not training.samples:
        return random_states(model, LOSS_STATES)
    few = training.evenly(LOSS_STATES).measurements
    return tuple(torch.cat([getattr(m, x) for m in few]) for x in ("q", "qd", "tau", "active"))


def random_states(model: ExportedModel, count: int) -> tuple[Tensor, ...]:
    """Return random q, q̇, τ and closed contacts within joint limits and the trained region, if known.

    At least one direction of motion is free.
    """
    robot, random = model.system.robot, torch.Generator().manual_seed(0)
    one = torch.ones(robot.nq, dtype=torch.float64)
    limits = [
        (robot.lower.clamp(min=-2.0), robot.upper.clamp(max=2.0)),
        (-one, one),
        (-10.0 * one, 10.0 * one),
    ]
    if LOW in model.tensors:
        limits[1:] = zip(model.tensors[LOW], model.tensors[HIGH], strict=True)
    shares = torch.rand(3, count, robot.nq, dtype=torch.float64, generator=random)
    state = [low + share * (high - low) for (low, high), share in zip(limits, shares, strict=True)]
    closed = torch.rand(count, len(model.system.contacts), generator=random) < 0.7
    # If contacts hold the arm completely, its accelerations are only rounding errors.
    return *state, closed & (closed.cumsum(-1) < robot.nq)


def _reference(model: ExportedModel, fit: Predictor, name: str) -> str:
    """Return C tables of states, and of the mean, covariance and Jacobians that Python computes for them."""
    q, qd, tau, active = random_states(model, STATES)
    read = fit.predict(q, qd, tau, list(READ[:-1]), active=active)  # pyright: ignore[reportArgumentType]
    assert read.covariance is not None
    wanted = " | ".join(f"{name.upper()}_{x.upper()}" for x in READ[:-1])
    reduced, real = int(model.functions is not None), "float" if model.dtype == torch.float32 else "double"
    sizes = f"STATES = {STATES}, D = {read.mean.shape[1]}, REDUCED = {reduced}, WANTED = {wanted}"
    lines = [f"enum {{ {sizes} }};"]
    tolerance = TOLERANCE * torch.finfo(model.dtype).eps / torch.finfo(torch.float64).eps
    lines.append(f"static const double TOLERANCE = {tolerance!r}, ZERO = {ZERO!r};")
    flags = torch.nn.functional.pad(active, (0, int(not active.shape[1]))).int()
    tables = {"q": q, "qd": qd, "tau": tau, "mean": read.mean, "covariance": read.covariance.flatten(1)}
    tables["slopes"] = q.new_zeros(len(q), 1)
    if model.jacobians:
        along = fit.linearize(q, qd, tau, active=active)
        both = [torch.stack(along[at : at + 3], dim=-2).flatten(1) for at in (1, 5)]
        tables["slopes"] = torch.cat(both, dim=1)
        lines.append("#define JACOBIANS")
    lines.append(f"enum {{ SLOPES = {tables['slopes'].shape[1]} }};")
    if model.wrench is not None or model.reads_contacts:
        # The accelerations are within the model's errors, since rounding errors grow with the wrench.
        std = read.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt()
        far = torch.linspace(-2.0, 2.0, len(q), dtype=q.dtype)[:, None]
        qdd = (read.mean + far * std)[:, read.parts["qdd"]]
        closed = dict(zip(model.system.contact_names, active.unbind(1), strict=True))
        time, header = torch.arange(len(q), dtype=q.dtype), DataHeader(ordered=False)
        data = Dataset(time, q, qd, tau, qdd, model.system.robot.joint_names, contact=closed, header=header)
        assert isinstance(fit, LearnedForces)
        tables["qdd"], read = qdd, dict[str, Prediction]()
        if model.wrench is not None:
            read["wrench"] = external_wrench(fit, data, model.wrench, "acceleration")
        if model.reads_contacts:
            read["contact_force"] = contact_force(fit, data, None, None)
            lines.append("#define CONTACT_FORCE")
        for key, x in read.items():
            assert x.covariance is not None
            tables |= {key: x.mean, f"{key}_covariance": x.covariance.flatten(1)}
    for key, x in {**tables, "closed": flags}.items():
        kind = {"closed": "unsigned char"}.get(key, real if key in ("q", "qd", "tau", "qdd") else "double")
        rows = ",\n  ".join("{" + ", ".join(map(repr, row)) + "}" for row in x.tolist()).replace("nan", "NAN")
        lines.append(f"static const {kind} {key}[STATES][{x.shape[1]}] = {{{rows}}};")
    return "\n".join(lines)
