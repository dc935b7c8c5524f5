"""C99 source text of a fitted model: its numbers, its straight-line mechanics, and the code of its priors.

What does not depend on the model, from the equations of motion to reading a quantity, is in `controller.c`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib.resources import files
from itertools import accumulate

import numpy as np
import torch
from torch import Tensor

from forcegp.compiled.mechanics import _forces, _point_blocks
from forcegp.compiled.program import Links, Program, regressor_program, trace
from forcegp.compiled.source import c_function
from forcegp.constraints import SurfaceContact
from forcegp.constraints.gauss import rank_tolerance
from forcegp.forces.noise import GROWTH, HIGH, LOW, SPREAD, STICK_NOISE, STICK_SPEED
from forcegp.forces.priors import contact
from forcegp.forces.priors.base import CONSTRAINT, CONTACT, JOINT, ForcePrior
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import TERMS, JointForcePrior, JointFrictionPrior
from forcegp.forces.quantities import QUANTITIES
from forcegp.gp import kernels
from forcegp.gp.basis import KernelPart
from forcegp.gp.features import SMALLEST_FRACTION, stacked
from forcegp.models.export.model import ExportedModel, Functions

READ = (*QUANTITIES, "joint_friction")
"""The quantities of the C code, in the order of its bits; the last one is not in `QUANTITIES`."""
TARGETS, SURFACES = (JOINT, CONTACT, CONSTRAINT), ("plane", "sphere", "cylinder")
ALONG = {
    "position": [f"dot3(at->tangent[{i}], at->position)" for i in range(2)],
    "velocity": [f"dot3(at->tangent[{i}], at->velocity)" for i in range(2)],
    "speed": ["sqrt(fmax(dot3(at->sliding, at->sliding), 1e-30))"],
}
"""Inputs along a surface, of `touching *at`."""
ARGUMENTS = """const double *restrict q, const double *restrict qd, const double *restrict tau,
    const equations *restrict e, const double *restrict gain, int spread, latent *restrict f"""


def c_source(model: ExportedModel, name: str) -> tuple[str, str]:
    """Header and source text.

    Raises:
        ModelError: a part of the model has no C form; names it.
    """
    model.check()
    before, _, rest = template("controller.c").partition("/* HELPERS")
    helpers, after = rest.split("/* PRIORS */\n")
    writer = Writer(model)
    priors = writer.priors()
    used = (
        text for text in helpers.strip().split("\n\n")[1:] if any(f" {_called(text)}(" in x for x in priors)
    )
    head = '#include <math.h>\n#include <string.h>\n#include "forcegp.h"\n'
    head += "#ifdef __cplusplus\n#define restrict __restrict__\n#endif\n"
    blocks = [head, "\n".join(writer.lines), *_mechanics(model), before, *used, *priors, after]
    robot, contacts = model.system.robot, model.system.contact_names
    fields = {
        "nq": robot.nq,
        "contacts": len(contacts),
        "joints": _comment(", ".join(robot.joint_names)),
        "touching": _comment(", ".join(contacts) or "none"),
        "bits": "\n".join(f"#define FORCEGP_{x.upper()} {1 << i}u" for i, x in enumerate(READ)),
    }
    return tuple(  # pyright: ignore[reportReturnType]
        text.replace("forcegp_", f"{name}_")
        .replace("forcegp.h", f"{name}.h")
        .replace("FORCEGP_", f"{name.upper()}_")
        for text in (template("controller.h", fields), "\n".join(blocks))
    )


def template(name: str, fields: dict[str, object] | None = None) -> str:
    """A file beside this one, each `@field@` filled in."""
    text = files("forcegp.models.export").joinpath(name).read_text(encoding="utf-8")
    for field, value in (fields or {}).items():
        text = text.replace(f"@{field}@", str(value))
    return text


def _comment(text: str) -> str:
    """Names as they may stand in a comment of code that is run: a model file must not end the comment."""
    return re.sub(r"[^\w ,.+-]", "_", text)


def _called(text: str) -> str:
    """The name of the function that a C text defines."""
    return text.partition("static ")[2].partition("(")[0].split()[-1]


def _mechanics(model: ExportedModel) -> list[str]:
    """M, Q_C, Q_G and, for each contact, position, Jacobian and bias acceleration; forward dynamics; Y."""
    robot, links = model.system.robot, Links(model.system.robot)
    blocks = _forces(links)
    for touching in model.system.contacts:
        ((frame, point),) = touching.anchors
        at = np.asarray([float(x) for x in point])
        blocks += _point_blocks(links, robot, robot.frame_index(frame), at)[1:]
    outputs = [x for block in blocks for x in block.flat]
    programs = {
        "mechanics": Program(("q", "qd"), (len(outputs),), links.graph, outputs),
        "forward_dynamics": trace(robot, "forward_dynamics"),
    }
    if any(isinstance(prior, InertialPrior) for prior in model.posterior.priors):
        programs["regressor"] = regressor_program(Links(robot))
    return [f"#define MECHANICS {len(outputs)}", *(c_function(*item) for item in programs.items())]


class Writer:
    """Writes the code of priors, and in `lines` the tables that it reads."""

    def __init__(self, model: ExportedModel) -> None:
        self.model, self.parts, self.lines = model, model.parts(), []
        self.starts = list(accumulate((part.components for part in self.parts), initial=0))
        self._constants()
        self._noise()

    def array(self, values: Tensor | Iterable[float], name: str = "", kind: str = "double") -> str:
        """A constant array, and its name."""
        x = values if isinstance(values, Tensor) else torch.tensor(list(values), dtype=torch.float64)
        name = name or f"TABLE_{len(self.lines)}"
        rows = x.detach().double().reshape(-1, x.shape[-1] if x.ndim else 1).tolist() or [[0.0]]
        texts = [", ".join(repr(v) if kind == "double" else str(int(v)) for v in row) for row in rows]
        rows = [f"{{{text}}}" for text in texts] if x.ndim > 1 else texts[0].split(", ")
        body = ",\n  ".join(rows)
        shape = "".join(f"[{n}]" for n in x.shape) if x.numel() else "[1]"
        self.lines.append(f"static const {kind} {name}{shape} = {{\n  {body}}};")
        return name

    def _constants(self) -> None:
        system, process = self.model.system, self.model.posterior.process
        robot, contacts = system.robot, [c for c in system.contacts if isinstance(c, SurfaceContact)]
        sizes = {"multiplier": len(contacts), "contact_force": 3 * len(contacts)}
        sizes = [sizes.get(name, robot.nq) for name in READ]
        defined = {
            "NQ": robot.nq,
            "CONTACTS": len(contacts),
            "ROWS": len(contacts),
            "SOME(n)": "((n) > 0 ? (n) : 1)",
            "COMPONENTS": self.starts[-1],
            "RANK": self.parts[0].rank,
            "MOST_FUNCTIONS": max(part.weights.shape[1] for part in self.parts),
            "SIGN": f"({self.model.sign}.0)",
            "QUANTITIES": len(READ),
            "SIZE_OF_ALL": sum(sizes),
            "COULOMB": len(process.coulomb),
            "SMALLEST_FRACTION": repr(SMALLEST_FRACTION),
            "RANK_TOLERANCE": repr(rank_tolerance(robot.dtype)),
        }
        self.lines += [f"#define {name} {value}" for name, value in defined.items()]
        self.lines.append("enum { JOINT, CONTACT, CONSTRAINT, JOINT_FRICTION, PLANE = 0, SPHERE, CYLINDER };")
        self.array(sizes, "SIZES", "int")
        owners = [part.prior for part in self.parts for _ in range(part.components)]
        self.array([TARGETS.index(prior.target) for prior in owners], "TARGET", "int")
        self.array([float(isinstance(prior, JointFrictionPrior)) for prior in owners], "IS_FRICTION", "int")
        for name in ("damping", "friction", "friction_velocity", "stribeck", "stribeck_velocity"):
            self.array(getattr(robot, name), name.upper())
        terms = process.mean.terms  # pyright: ignore[reportFunctionMemberAccess]
        self.array([float(term in terms) for term in TERMS], "MEAN_TERMS")
        for part, start in zip(self.parts, self.starts, strict=False):
            if isinstance(part.prior, InertialPrior):
                self.lines.append(f"#define INERTIAL {start}")
                self.lines.append(f"#define INERTIAL_COLUMNS {part.components}")
                self.array(part.prior.scale(robot), "INERTIAL_SCALE")
        if contacts:
            self._surfaces(contacts)
        if process.coulomb:
            where = [system.contact_names.index(x.contact) for x in process.coulomb]
            self.array(where, "COULOMB_CONTACT", "int")
            self.array([float(x.coefficient) for x in process.coulomb], "COULOMB_COEFFICIENT")
            self.array([float(x.smoothing) for x in process.coulomb], "COULOMB_SMOOTHING")

    def _noise(self) -> None:
        """Variances beside those of the learned forces, and the trained region."""
        nq, values = self.model.system.robot.nq, self.model.tensors
        zero, far = torch.zeros(nq, dtype=torch.float64), torch.full((2, nq), 1e300, dtype=torch.float64)
        for key, name, default in ((LOW, "LOW", -far), (HIGH, "HIGH", far), (SPREAD, "SPREAD", far)):
            self.array(values.get(key, default), name)
        self.array(values.get(GROWTH, zero), "GROWTH")
        sticks = STICK_NOISE in values
        self.array((2.0 * values[STICK_NOISE]).exp() if sticks else zero, "STICK_VARIANCE")
        self.array(values[STICK_SPEED].exp() if sticks else zero + 1.0, "STICK_SPEED")
        for name, std in (("TORQUE", self.model.torque_std), ("EXTERNAL", self.model.external_std)):
            self.array(zero if std is None else std.expand(nq) ** 2, f"{name}_VARIANCE")
        sensors = [self.array(self.model.noise[x] ** 2) if x in self.model.noise else "0" for x in READ]
        self.lines.append(f"static const double *const SENSOR_VARIANCE[] = {{{', '.join(sensors)}}};")

    def _surfaces(self, contacts: list[SurfaceContact]) -> None:
        """The surfaces that the tips move on, and the gains of the stabilization b − 2ωξ ċ − ω² c."""
        on, zero = [contact.center_surface for contact in contacts], (0.0, 0.0, 0.0)
        self.array([SURFACES.index(vars(x)["type"]) for x in on], "SURFACE", "int")
        self.array(torch.tensor([vars(x).get("center", zero) for x in on], dtype=torch.float64), "CENTER")
        axes = [vars(x).get("normal", vars(x).get("axis", zero)) for x in on]
        self.array(torch.tensor(axes, dtype=torch.float64), "AXIS")
        self.array([vars(x)["offset" if "offset" in vars(x) else "radius"] for x in on], "SIZE")
        self.array([contact.radius for contact in contacts], "TIP")
        rule = self.model.system.baumgarte
        omega, xi = (0.0, 0.0) if rule is None else (rule.natural_frequency, rule.damping_ratio)
        self.lines += [f"#define RATE_GAIN {2.0 * omega * xi!r}", f"#define ERROR_GAIN {omega**2!r}"]

    def priors(self) -> list[str]:
        """A function for each prior, and the one that calls them all."""
        texts, calls = [], []
        for p, part in enumerate(self.parts):
            body = [*self._operator(part, self.starts[p]), *self._functions(p, part)]
            title = f"/* {_comment(part.prior.name)}: {type(part.prior).__name__} */\n"
            title += f"static int prior_{p}({ARGUMENTS}) {{\n"
            unread = "  (void)q, (void)qd, (void)tau, (void)e, (void)gain, (void)spread;\n"
            texts.append(title + unread + "\n".join(body) + "\n  return 0;\n}\n")
            calls.append(f"  if (prior_{p}(q, qd, tau, e, gain, spread, f) != 0) return FORCEGP_JAMMED;\n")
        texts.append(f"static int latent_forces({ARGUMENTS}) {{\n{''.join(calls)}  return 0;\n}}\n")
        return texts

    def _operator(self, part: Functions, start: int) -> list[str]:
        """Code of E(x), which carries f to generalized forces; that of `INERTIAL` is in `controller.c`."""
        prior, E = part.prior, f"f->E + {start}"
        if isinstance(prior, InertialPrior):
            return []
        if isinstance(prior, contact.NormalForcePrior):
            return [f"  along_constraint(e, {E});"]
        if not isinstance(
            prior, contact.ContactForcePrior | contact.SlidingFrictionPrior | contact.CoulombErrorPrior
        ):
            return [f"  identity({part.components}, {E});"]
        c = self.model.system.contact_names.index(prior.contact)
        if isinstance(prior, contact.CoulombErrorPrior):
            law = next(x for x in prior.friction if x.contact == prior.contact)
            numbers = f"{float(law.coefficient)!r}, {float(law.smoothing)!r}"
            return [f"  friction_error(e, tau, gain, {c}, {numbers}, {E});"]
        at = f"  const touching *const at = &e->contact[{c}];"
        if not isinstance(prior, contact.SlidingFrictionPrior):
            return [at, f"  tangential(e, {c}, {E});"]
        terms = self.array([contact.TERMS.index(term) for term in prior.terms], kind="int")
        numbers = (prior.smoothing, prior.friction_coefficient, prior.stribeck_speed, prior.torsion_smoothing)
        called = f"against(e, qd, {c}, {terms}, {len(prior.terms)}, {', '.join(map(repr, numbers))}, {E})"
        return [at, f"  if (! {called}) return 1;"]

    def _functions(self, p: int, part: Functions) -> list[str]:
        """Code of the functions V of each component, and of their posterior."""
        inputs, shared = self._inputs(p, part)
        lines, m = [inputs], part.size
        kernel = KernelCode(self, part, shared, lines)
        for k in range(part.components):
            value, variance = ("", "0.0") if part.rest is None else kernel.covariance(part.rest, k)
            phi = [] if part.finite is None else kernel.features(part.finite, k)
            lines += [f"  {{\n    double V[{part.weights.shape[1] or 1}];"]
            if m:
                lines.append(f"    for (int j = 0; j < {m}; ++j) V[j] = {value};")
            lines += [f"    V[{m + i}] = {feature};" for i, feature in enumerate(phi)]
            white, kept = "0", 0
            if part.whitening is not None and m:
                white, kept = self.array(part.whitening[k].flatten()), part.whitening[k].shape[1]
            tables = f"{self.array(part.weights[k])}, {white}, {kept}, {self.array(part.roots[k].flatten())}"
            rest = f"{part.first[k]}, spread, {self.starts[p] + k}, f"
            lines.append(f"    component(V, {m}, {len(phi)}, {variance}, {tables}, {rest});\n  }}")
        return lines

    def _inputs(self, p: int, part: Functions) -> tuple[str, bool]:
        """Code of the standardized inputs x, and whether all components share them."""
        raw, scales = self._raw_inputs(part.prior), self.model.posterior.process.scales[p]
        shared, rows = all(x.ndim == 2 for x in part.support.values()), []
        for k in range(1 if shared else part.components):
            row = []
            for name, columns in raw.items():
                given = columns if shared else [columns[k]]
                pair = ((x if shared else x[k]).tolist() for x in (scales.mean[name], scales.std[name]))
                row += [f"({x} - {m!r}) / {s!r}" for x, m, s in zip(given, *pair, strict=True)]
            rows.append(row)
        body = ",\n".join(f"    {{{', '.join(row)}}}" for row in rows)
        return f"  const double x[{len(rows)}][{len(rows[0])}] = {{\n{body}}};\n  (void)x;", shared

    def _raw_inputs(self, prior: ForcePrior) -> dict[str, list[str]]:
        """C expressions of the inputs by name; of joint friction, one for each joint."""
        joints, revolute = range(self.model.system.robot.nq), self.model.system.robot.revolute.bool().tolist()
        if isinstance(prior, contact.NormalForcePrior):
            return self._raw_inputs(prior.like)
        if isinstance(prior, JointFrictionPrior):
            raw = {"velocity": [f"qd[{i}]" for i in joints]}
            for n, speed in enumerate(prior.speeds):
                raw[f"coulomb_{n}"] = [f"tanh(qd[{i}] / {speed!r})" for i in joints]
            if prior.load:
                raw["load"] = [f"fabs(e->Q_G[{i}]) * {raw['coulomb_0'][i]}" for i in joints]
            return raw
        if isinstance(prior, contact.SurfaceForcePrior):
            return {name: ALONG[name] for name in prior.inputs}
        if not isinstance(prior, JointForcePrior):
            return {"one": ["0.0"]}
        raw = {name: [f"{name}[{i}]" for i in joints] for name in prior.inputs}
        if prior.periodic and "q" in raw:
            raw["q"] = [f"{turn}(q[{i}])" for turn in ("sin", "cos") for i in joints if revolute[i]]
            raw["q"] += [f"q[{i}]" for i in joints if not revolute[i]]
        return raw


class KernelCode:
    """C code of the kernel of one prior; what a leaf needs is computed once in front of its use."""

    def __init__(self, writer: Writer, part: Functions, shared: bool, lines: list[str]) -> None:
        self.writer, self.part, self.shared, self.lines = writer, part, shared, lines
        self._known: dict[tuple[int, int], str] = {}

    def _x(self, kernel: kernels.Linear | kernels.Stationary, k: int, scale: Tensor) -> list[str]:
        """The inputs of a kernel, each with its factor."""
        widths = {name: x.shape[-1] for name, x in self.part.support.items()}
        starts = dict(zip(widths, accumulate(widths.values(), initial=0), strict=False))
        names = tuple(widths) if kernel.inputs is None else kernel.inputs
        columns = [starts[name] + i for name in names for i in range(widths[name])]
        row, factors = 0 if self.shared else k, scale.expand(len(columns)).tolist()
        return [f"{s!r} * x[{row}][{c}]" for c, s in zip(columns, factors, strict=True)]

    def features(self, part: KernelPart, k: int) -> list[str]:
        """φ(x) of component k."""
        kernel, params = part.kernel, part.params
        if isinstance(kernel, kernels.Linear):
            bias = float(_row(kernel.bias_std(params), k))
            return [*self._x(kernel, k, _row(kernel.slope_std(params), k)), repr(bias)]
        if isinstance(kernel, kernels.Constant):
            return [repr(float(_row(kernel.std(params), k)))]
        assert isinstance(kernel, kernels.Sum)
        left, right = (self.features(KernelPart(*side), k) for side in kernel.parts(params))
        return (
            [f"{a} * {b}" for a in left for b in right]
            if isinstance(kernel, kernels.Product)
            else left + right
        )

    def covariance(self, part: KernelPart, k: int) -> tuple[str, str]:
        """k(x, z_j) and k(x, x) of component k."""
        kernel, params = part.kernel, part.params
        if isinstance(kernel, kernels.Sum):
            (a, aa), (b, bb) = (self.covariance(KernelPart(*side), k) for side in kernel.parts(params))
            sign = "*" if isinstance(kernel, kernels.Product) else "+"
            return f"({a} {sign} {b})", f"({aa} {sign} {bb})"
        if isinstance(kernel, kernels.Constant):
            value = repr(float(_row(kernel.std(params), k).square()))
            return value, value
        if isinstance(kernel, kernels.Linear):
            # k = Σ_d (s σ_d)² x_d x′_d + σ_0²
            bias = float(_row(kernel.bias_std(params), k).square())
            common = kernel.shared and self.shared
            size = float((2.0 * params["log_std"][k]).exp()) if common else 1.0
            slope = params["log_slope_std"][0].exp() if common else _row(kernel.slope_std(params), k)
            x, Z = self._x(kernel, k, slope), self._support(kernel, k) * slope
            u = self._leaf((id(params["log_slope_std"]), 0 if common else k), "combine", x, Z)
            square = " + ".join(f"({a}) * ({a})" for a in x)
            return f"({size!r} * {u}[j] + {bias!r})", f"({size!r} * ({square}) + {bias!r})"
        assert isinstance(kernel, kernels.Stationary)
        variance, inverse = (
            float(_row((2.0 * params["log_std"]).exp(), k)),
            torch.exp(-params["log_lengthscale"]),
        )
        each, scale = 0 if self.shared and len(inverse) == 1 else k, _row(inverse, k)
        x, Z = self._x(kernel, k, scale), self._support(kernel, k) * scale
        u = self._leaf((id(params["log_lengthscale"]), each), type(kernel).__name__.lower(), x, Z)
        return f"{variance!r} * {u}[j]", repr(variance)

    def _support(self, kernel: kernels.Linear | kernels.Stationary, k: int) -> Tensor:
        z = stacked(self.part.support, kernel.inputs)
        return z if z.ndim == 2 else z[k]

    def _leaf(self, key: tuple[int, int], kind: str, x: list[str], Z: Tensor) -> str:
        """A local array over the support points: xᵀz_j (`combine`), or a profile of |x − z_j|."""
        m = self.part.size
        if key not in self._known and m:
            u = self._known[key] = f"u{len(self._known)}"
            table = self.writer.array(Z.mT.flatten())
            self.lines.append(f"  double {u}[{m}];\n  {{\n    const double scaled[] = {{{', '.join(x)}}};")
            if kind == "combine":
                self.lines.append(f"    combine({table}, scaled, {len(x)}, {m}, {u});\n  }}")
            else:
                self.lines.append(
                    f"    squares(scaled, {table}, {len(x)}, {m}, {u});\n    {kind}({u}, {m});\n  }}"
                )
        return self._known.get(key, "")


def _row(x: Tensor, k: int) -> Tensor:
    """The row of component k, or the one that all share."""
    return x[k if len(x) > 1 else 0]
