"""C99 source text of a fitted model: its numbers, its straight-line mechanics, and the code of its priors.

`controller.c` contains the code that is the same for all models.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from forcegp.compiled.program import Links, regressor_program, trace
from forcegp.compiled.source import c_function
from forcegp.constraints import SurfaceContact
from forcegp.constraints.gauss import rank_tolerance
from forcegp.forces.external_wrench import MULTIPLIER_STD
from forcegp.forces.posterior import GROWTH, HIGH, LOW, MEMORY, SPREAD, STICK_NOISE, STICK_SPEED
from forcegp.forces.priors import contact
from forcegp.forces.priors.base import CONSTRAINT, CONTACT, JOINT
from forcegp.forces.priors.constants import DrivePrior
from forcegp.forces.priors.inertial import PER_PAYLOAD, InertialPrior, PayloadPrior
from forcegp.forces.priors.joint import TERMS
from forcegp.forces.quantities import PREDICTED, ROUNDED
from forcegp.forces.term import JointTerm, PerJointPrior
from forcegp.forces.unknowns import tip_keys, unknown_tip
from forcegp.gp import kernels
from forcegp.gp.basis import KernelPart
from forcegp.gp.draws import MISSED_FEATURES
from forcegp.gp.features import SMALLEST_FRACTION, stacked
from forcegp.gp.sparse import SparsePosterior
from forcegp.learning.specification import REST_SPEED
from forcegp.models.export.mean import ARGUMENTS, DIFFERENTIATED, LearnedMotion
from forcegp.models.export.model import ExportedModel, Functions, row_of
from forcegp.models.external_wrench import LEAST_VARIANCE
from forcegp.models.prediction import NEGATIVE, ROUNDING
from forcegp.rollout import law

NO_FRICTION = 10
"""Error code of the C code if no dry friction solves the problem in `rollout/law.py`."""
LAW = ("REGULARIZATION", "CONTRADICTION", "BLOCK_TRIALS", "MAX_EXCHANGES")
LAW += ("INSTANT", "STILL", "NEAR_REST", "NUDGE")
READ = tuple(PREDICTED)
"""Quantities of the C code, in the order of their bits."""
STEPS = 2e-5, 1e-3
"""Steps of fourth-order differences in q and q̇, and in τ and q̈. Friction changes within 0.01 rad/s."""
LANES = 16
"""Numbers that a loop of the C code computes at a time: two of the widest vector registers."""
TARGETS = (JOINT, CONTACT, CONSTRAINT)
GIVEN = """const double *restrict q, const double *restrict qd, const double *restrict tau,
    const equations *restrict e, const double *restrict gain, int spread, latent *restrict f"""
SLOPES = "const equations *restrict e, double *restrict f, double *restrict slope"


def c_source(model: ExportedModel, name: str, rollout: bool = False) -> tuple[str, str]:
    """Return the header and the source text, for predictions or, for a rollout, the motion of trajectories.

    Raises:
        ModelError: a part of the model has no C form. The message names it.
    """
    model.check()
    before, _, rest = template("controller.c").partition("/* HELPERS")
    helpers, after = rest.split("/* PRIORS */\n")
    writer = Writer(model, rollout)
    priors = writer.priors()
    each = helpers.strip().split("\n\n")[1:]
    used = (text for text in each if any(f" {_called(text)}(" in x for x in priors))
    head = GUIDE + '#include <math.h>\n#include <string.h>\n#include "forcegp.h"\n'
    head += "#ifdef __cplusplus\n#define restrict __restrict__\n#endif\n"
    blocks = [head, "\n".join(writer.lines), *_programs(writer, rollout), before, *used, *priors, after]
    blocks += [template("motion.c", writer.sticking())] if rollout else []
    blocks += [template("jacobian.c")] if writer.differentiates else []
    blocks += [template("online.c")] if model.online else []
    blocks += [template("measured.c")] if writer.measures else []
    robot, contacts = model.system.robot, model.system.contact_names
    fields = {
        "nq": robot.nq,
        "contacts": len(contacts),
        "joints": _comment(", ".join(robot.joint_names)),
        "touching": _comment(", ".join(contacts) or "none"),
        "bits": "\n".join(f"#define FORCEGP_{x.upper()} {1 << i}u" for i, x in enumerate(READ)),
        "online": writer.online_header(),
        "wrench": writer.wrench_header(),
        "contact_force": template("contact_force.h") if model.reads_contacts else "",
        "jacobian": template("jacobian.h") if model.jacobians else "",
    }
    precise = in_single_precision if model.dtype == torch.float32 else str
    return tuple(  # pyright: ignore[reportReturnType]
        precise(text)
        .replace("forcegp_", f"{name}_")
        .replace("forcegp.h", f"{name}.h")
        .replace("FORCEGP_", f"{name.upper()}_")
        for text in (template("controller.h", fields), "\n".join(blocks))
    )


GUIDE = """/* Tables of numbers come first, then straight-line code, and from `dot` on what can be read:
 *
 *   mechanics     M, Q_C, Q_G, Q_D, touching points; inputs x and features phi of the priors
 *   assemble      A, b, M^-1, H and L of these: the struct `equations`
 *   component     mean and covariance of one latent force f, from its kernel functions
 *   prior_0, ...  kernel and generalized force E of each prior, named above it
 *   maps          every quantity as an affine map of the forces
 *   predict       all of it, at one state
 */
"""
NUMBER = re.compile(r"/\*.*?\*/|(?<![\w.])(?:\d+\.\d*(?:e[+-]?\d+)?|\d+e[+-]?\d+)(?![\w.])", re.DOTALL)
"""A comment, or a number with a fraction or an exponent."""


def in_single_precision(text: str) -> str:
    """Return the C text with `float` in place of `double`; `tgmath.h` selects the functions."""
    largest = torch.finfo(torch.float32).max

    def literal(match: re.Match[str]) -> str:
        if match[0].startswith("/"):
            return match[0]
        return f"{np.float32(min(float(match[0]), largest))!s}f"

    text = re.sub(r"\bdouble\b", "float", NUMBER.sub(literal, text))
    return text.replace("#include <math.h>", "#include <math.h>\n#include <tgmath.h>")


def template(name: str, fields: Mapping[str, object] | None = None) -> str:
    """Return the text of a template file with each `@field@` filled in."""
    text = files("forcegp.models.export").joinpath(name).read_text(encoding="utf-8")
    for field, value in (fields or {}).items():
        text = text.replace(f"@{field}@", str(value))
    return text


def _comment(text: str) -> str:
    """Return names sanitized for a C comment, since a name in a model file must not end the comment."""
    return re.sub(r"[^\w ,.+-]", "_", text)


def _called(text: str) -> str:
    """Return the name of the function that a C text defines."""
    return text.partition("static ")[2].partition("(")[0].split()[-1]


def _programs(writer: Writer, rollout: bool) -> list[str]:
    """Return the code for mechanics with contacts, forward dynamics, Y, and Jacobians or sliding friction."""
    mean, robot = writer.mean, writer.mean.robot
    blocks = [mean.M, mean.Q_C, mean.Q_G, mean.Q_D, *(x for at in mean.touching for x in at), *mean.x]
    outputs = [x for block in blocks for x in block.flat]
    outputs += [*(x for features in mean.phi for phi in features for x in phi), *mean.expected]
    programs = {"mechanics": mean.program(outputs, ARGUMENTS[:3])}
    programs["forward_dynamics"] = trace(robot, "forward_dynamics")
    if any(isinstance(part.prior, InertialPrior | PayloadPrior) for part in mean.parts):
        programs["regressor"] = regressor_program(Links(robot))
    if mean.model.wrench is not None and not rollout:
        programs["wrench_jacobian"] = mean.wrench_jacobian(mean.model.wrench)
    if rollout:
        programs["sliding"] = mean.program(mean.sliding()[1], (*ARGUMENTS[:3], "slip"))
    if writer.differentiates:
        quantities = mean.quantities()
        values = np.concatenate([quantities[x] for x in DIFFERENTIATED])
        programs["slopes_of_mean"] = mean.program(mean.tangents(values).flat, (*ARGUMENTS, "f", "slope"))
    return [f"#define MECHANICS {len(outputs)}", *(c_function(*item) for item in programs.items())]


def _padded(count: int) -> int:
    """Return the next multiple of `LANES`."""
    return -(-count // LANES) * LANES


def _touched(parts: Sequence[Functions], sign: int) -> tuple[list[bool], list[bool]]:
    """Return whether data affect the functions of each component, and the columns of C that they fill.

    The other components have C = 1, with zeros in the rows of other functions. The first one is always kept.
    """
    columns = [True] * parts[0].rank
    pairs = [(C, first) for part in parts for C, first in zip(part.roots, part.first, strict=True)]
    if sign < 0:
        return [True] * len(pairs), columns
    C = torch.cat([torch.nn.functional.pad(C, (first, 0)) for C, first in pairs])
    alone = (torch.eye(len(C), dtype=C.dtype) != C).logical_not()
    alone = alone.all(0) & alone.all(1)
    touched = [i == 0 or not bool(alone[a : a + len(C)].all()) for i, (C, a) in enumerate(pairs)]
    for (C, a), used in zip(pairs, touched, strict=True):
        columns[a : a + len(C)] = [used] * len(C)
    return touched, columns


class Writer:
    """Writer of the code for the priors. `lines` contains the tables that this code reads."""

    def __init__(self, model: ExportedModel, rollout: bool) -> None:
        self.model, self.lines, self.rollout = model, list[str](), rollout
        # Samples of functions are drawn for all inertial parameters.
        self.parts = model.parts() if rollout else model.parts_of_motion()
        self.differentiates = model.jacobians and not rollout
        self.measures = not rollout and (model.wrench is not None or model.reads_contacts)
        self.mean, self._tables = LearnedMotion(model, self.parts, differentiate=True), dict[str, str]()
        self.starts = list(accumulate((part.components for part in self.parts), initial=0))
        self.tables: list[list[str]] = []
        # Components whose functions the data do not affect are independent of all others.
        self.touched, self.kept = _touched(self.parts, model.sign)
        self.width = _padded(sum(self.kept))
        self._constants()
        self._noise()
        self._online()
        self._measured()

    def array(self, values: Tensor | Iterable[float], name: str = "", kind: str = "double") -> str:
        """Add a constant array unless it already exists, and return its name."""
        x = values if isinstance(values, Tensor) else torch.tensor(list(values), dtype=torch.float64)
        rows = x.detach().double().reshape(-1, x.shape[-1] if x.ndim else 1).tolist() or [[0.0]]
        texts = [", ".join(repr(v) if kind == "double" else str(int(v)) for v in row) for row in rows]
        rows = [f"{{{text}}}" for text in texts] if x.ndim > 1 else texts[0].split(", ")
        body = ",\n  ".join(rows)
        shape = "".join(f"[{n}]" for n in x.shape) if x.numel() else "[1]"
        text = f"{shape} = {{\n  {body}}};"
        if name or text not in self._tables:
            self._tables[text] = name or f"TABLE_{len(self.lines)}"
            self.lines.append(f"static const {kind} {self._tables[text]}{text}")
        return self._tables[text]

    def _constants(self) -> None:
        system, process = self.model.system, self.model.posterior.process
        robot, contacts = system.robot, [c for c in system.contacts if isinstance(c, SurfaceContact)]
        sizes = {"multiplier": len(contacts), "contact_force": 3 * len(contacts)}
        sizes = [sizes.get(name, robot.nq) for name in READ]
        coarser = torch.finfo(self.model.dtype).eps / torch.finfo(torch.float64).eps
        defined = {
            "NQ": robot.nq,
            "CONTACTS": len(contacts),
            "ROWS": len(contacts),
            "SOME(n)": "((n) > 0 ? (n) : 1)",
            "COMPONENTS": self.starts[-1],
            "RANK": self.parts[0].rank,
            "WIDTH": self.width,
            "COLUMNS": sum(self.kept),
            "PADDED": _padded(self.parts[0].rank),
            "LANES": LANES,
            "START(k)": "(POSITION[k] / LANES * LANES)",
            "FUNCTIONS": sum(len(C) for part in self.parts for C in part.roots),
            "MOST_FUNCTIONS": max(part.weights.shape[1] for part in self.parts),
            "SIGN": f"({self.model.sign}.0)",
            "QUANTITIES": len(READ),
            "MOST_UNKNOWNS": max(robot.nq, 3 * len(contacts), 6 + len(contacts)),
            "SIZE_OF_ALL": sum(sizes),
            "COULOMB": len(process.coulomb),
            "INPUTS": sum(x.size for x in self.mean.x),
            "FEATURES": sum(len(phi) for features in self.mean.phi for phi in features),
            "SUPPORTED": sum(part.components for part in self.parts if part.size),
            "SLOPES": sum(
                part.components * x.shape[1]
                for part, x in zip(self.parts, self.mean.x, strict=True)
                if part.size
            ),
            "DIFFERENTIATED": f"({' | '.join(f'FORCEGP_{x.upper()}' for x in DIFFERENTIATED)})",
            "INERTIA_LEARNED": int(any(isinstance(part.prior, InertialPrior) for part in self.parts)),
            # Sums of squares do not cancel.
            "SMALLEST_FRACTION": repr(SMALLEST_FRACTION * (coarser if self.model.sign < 0 else 1.0)),
            "EPSILON": repr(torch.finfo(self.model.dtype).eps),
            "NEGATIVE": repr(NEGATIVE),
            "ROUNDING": repr(ROUNDING),
            "RANK_TOLERANCE": repr(rank_tolerance(self.model.dtype)),
            "HIDDEN": repr(ROUNDED),
        }
        self.lines += [f"#define {name} {value}" for name, value in defined.items()]
        self.lines.append("enum { JOINT, CONTACT, CONSTRAINT, JOINT_FRICTION };")
        self.array(sizes, "SIZES", "int")
        if contacts:
            self.array([c.name in self.model.never_closed for c in contacts], "NEVER_CLOSED", "int")
        self.array(accumulate((len(w) for x in self.parts for w in x.weights), initial=0), "FOLDED", "int")
        rows = [len(C) for part in self.parts for C in part.roots]
        self.array(accumulate(rows, initial=0), "FUNCTION", "int")
        self.array([not kept for kept in self.touched], "INDEPENDENT", "int")
        self.array([sum(self.kept[:i]) for part in self.parts for i in part.first], "POSITION", "int")
        owners = [part.prior for part in self.parts for _ in range(part.components)]
        self.array([TARGETS.index(prior.target) for prior in owners], "TARGET", "int")
        self.array([float(isinstance(prior, JointTerm)) for prior in owners], "IS_FRICTION", "int")
        terms = process.mean.terms  # pyright: ignore[reportFunctionMemberAccess]
        self.array([float(term in terms) for term in TERMS], "MEAN_TERMS")
        scale = robot.torque_scale
        self.array(torch.ones_like(robot.mass) if scale is None else scale, "TORQUE_SCALE")
        for part, start in zip(self.parts, self.starts, strict=False):
            if isinstance(part.prior, DrivePrior):
                self.lines += [f"#define DRIVES {start}", f"#define DRIVES_STD {part.prior.std!r}"]
                self.lines.append(f"#define DRIVES_MEASURED {int(part.prior.is_error)}")
            if isinstance(part.prior, InertialPrior):
                self.lines.append(f"#define INERTIAL {start}")
                self.lines.append(f"#define INERTIAL_COUNT {part.components}")
                columns, units = part.inertial(robot)
                self.array(columns, "INERTIAL_COLUMN", "int")
                self.array(units, "INERTIAL_UNITS")
            if isinstance(part.prior, PayloadPrior):
                self.lines += [f"#define PAYLOAD {start}", f"#define PAYLOAD_COUNT {part.components}"]
                first = PER_PAYLOAD * part.prior.link(robot)
                self.array(range(first, first + part.components), "PAYLOAD_COLUMN", "int")
                self.lines.append(f"#define PAYLOAD_MEASURED {int(part.prior.measured)}")
                self.array(part.prior.units(robot.mass), "PAYLOAD_UNITS")
        if process.coulomb:
            where = [system.contact_names.index(x.contact) for x in process.coulomb]
            self.array(where, "COULOMB_CONTACT", "int")
            self.array([float(x.coefficient) for x in process.coulomb], "COULOMB_COEFFICIENT")
            self.array([float(x.smoothing) for x in process.coulomb], "COULOMB_SMOOTHING")

    def _noise(self) -> None:
        """Add the variances that the learned forces do not include, and the trained region."""
        nq, values = self.model.system.robot.nq, self.model.tensors
        zero, far = torch.zeros(nq, dtype=torch.float64), torch.full((2, nq), 1e300, dtype=torch.float64)
        for key, name, default in ((LOW, "LOW", -far), (HIGH, "HIGH", far), (SPREAD, "SPREAD", far)):
            self.array(values.get(key, default), name)
        self.array(values.get(GROWTH, zero), "GROWTH")
        sticks = STICK_NOISE in values
        self.array((2.0 * values[STICK_NOISE]).exp() if sticks else zero, "STICK_VARIANCE")
        self.array(values[STICK_SPEED].exp() if sticks else zero + 1.0, "STICK_SPEED")
        names = self.model.system.contact_names
        tips = [unknown_tip(values, name) for name in names] or [(0.0, 0.0, 1.0)]
        self.array(torch.tensor(tips, dtype=torch.float64), "TIP")
        self.array([tip_keys(name).rests in values for name in names] or [0], "TIP_LEARNED", "int")
        for name, std in (("TORQUE", self.model.torque_std), ("EXTERNAL", self.model.external_std)):
            variance = zero if std is None else std.expand(nq) ** 2
            if name == "EXTERNAL" and MEMORY in values:  # a program follows no bristles
                variance = variance + (2.0 * values[MEMORY]).exp()
            self.array(variance, f"{name}_VARIANCE")
        sensors = [self.array(self.model.noise[x] ** 2) if x in self.model.noise else "0" for x in READ]
        self.lines.append(f"static const double *const SENSOR_VARIANCE[] = {{{', '.join(sensors)}}};")

    def _online(self) -> None:
        """Add the positions of each component's functions in the online state, and the noise of samples."""
        self.lines.append(f"#define ONLINE {int(self.model.online)}")
        if not self.model.online or self.model.sampling is None:
            return
        variance, power, moving = self.model.sampling
        parts, latent = self.parts, self.model.posterior.latent
        assert isinstance(latent, SparsePosterior)
        self.array(latent.joint_weights, "WEIGHTS")
        self.array([part.size for part in parts for _ in range(part.components)], "POINTS", "int")
        self.array(self.starts, "FIRST_COMPONENT", "int")
        self.array([i for i, kept in enumerate(self.kept) if kept], "COLUMN", "int")
        self.array(variance, "LEARNED_TORQUE_VARIANCE")
        group = "CONTACTS * 3 > NQ ? CONTACTS * 3 : NQ"
        self.lines.append(
            f"enum {{ PRIOR_COUNT = {len(parts)}, GROUP = {group}, LEADING = {latent.leading} }};"
        )
        self.lines.append(f"static const double REST_SPEED = {REST_SPEED if moving else -1.0!r};")
        self.lines.append(f"static const double TEMPERING = {power**0.5!r};")

    def _measured(self) -> None:
        """Add the priors of unknown forces that are estimated from accelerations."""
        frame, names = self.model.wrench, self.model.system.contact_names
        if not self.measures:
            return
        k = 0 if frame is None else len(frame.axes)
        unknowns = max(k + len(names) if k else 0, 3 * len(names))
        self.lines.append(f"enum {{ UNKNOWNS = {unknowns} }};")
        if frame is not None:
            self.array([*frame.prior.tolist(), *len(names) * [MULTIPLIER_STD]], "WRENCH_PRIOR")
            self.array(torch.stack(frame.levers), "LEVERS")
            self.lines.append(f"enum {{ LEVER_COUNT = {len(frame.levers)} }};")
            self.lines.append("static const double STATE_STEP = {!r}, FORCE_STEP = {!r};".format(*STEPS))
        if names:
            owners = [part.prior for part in self.parts for _ in range(part.components)]
            owners = [getattr(prior, "contact", None) for prior in owners]
            self.array([-1 if name is None else names.index(name) for name in owners], "OWNER", "int")
            self.lines.append(f"static const double NORMAL_STD = {MULTIPLIER_STD!r};")
            self.lines.append(f"static const double LEAST_VARIANCE = {LEAST_VARIANCE!r};")

    def wrench_header(self) -> str:
        """Return the part of the header for an external wrench, if there is one."""
        frame = self.model.wrench
        if frame is None:
            return ""
        fields = {"components": len(frame.axes), "axes": ", ".join(frame.axes), "reference": frame.reference}
        at = {"frame": _comment(frame.frame), "point": ", ".join(map(repr, map(float, frame.point)))}
        return template("wrench.h", fields | at)

    def online_header(self) -> str:
        """Return the part of the header for learning online if the model supports it."""
        names = ", ".join(f"{p} {_comment(part.prior.name)}" for p, part in enumerate(self.parts))
        folded = sum(part.weights.numel() for part in self.parts)
        fields = {"functions": self.parts[0].rank, "folded": folded, "priors": names}
        fields["contacts"] = max(len(self.model.system.contacts), 1)
        return template("online.h", fields) if self.model.online else ""

    def priors(self) -> list[str]:
        """Return a C function for each prior, and one that calls all of them."""
        texts, calls = [], []
        for p, part in enumerate(self.parts):
            body = [*self._operator(part, self.starts[p]), *self._functions(p, part)]
            title = f"/* {_comment(part.prior.name)}: {type(part.prior).__name__} */\n"
            title += f"static int prior_{p}({GIVEN}) {{\n"
            unread = "  (void)q, (void)qd, (void)tau, (void)e, (void)gain, (void)spread;\n"
            texts.append(title + unread + "\n".join(body) + "\n  return 0;\n}\n")
            calls.append(f"  if (prior_{p}(q, qd, tau, e, gain, spread, f) != 0) return FORCEGP_JAMMED;\n")
        for i, name in ((3, "ROOTS"), (1, "WHITENINGS"))[: 1 + self.model.online]:
            column = ", ".join(tables[i] for tables in self.tables)
            self.lines.append(f"static const double *const {name}[] = {{{column}}};")
        texts.append(f"static int latent_forces({GIVEN}) {{\n{''.join(calls)}  return 0;\n}}\n")
        if not self.rollout:
            return [*texts, *self._slopes()] if self.differentiates else texts
        chosen = "".join(calls[p] for p in self.mean.sliding()[0])
        unread = "  (void)q, (void)qd, (void)tau, (void)e, (void)gain, (void)spread, (void)f;\n"
        return [*texts, f"static int sticking_forces({GIVEN}) {{\n{unread}{chosen}  return 0;\n}}\n"]

    def sticking(self) -> dict[str, object]:
        """Return the `motion.c` tables for friction of sticking joints: components, inputs and features."""
        (priors, outputs), x, phi = self.mean.sliding(), self.mean.x, self.mean.phi
        sizes = [sum(map(len, features)) for features in phi]
        places = [("x", sum(each.size for each in x[:p]), x[p].size) for p in priors]
        places += [("phi", sum(sizes[:p]), sizes[p]) for p in priors]
        copies, first = "", self.mean.robot.nq
        for name, start, size in places:
            copies += f"  memcpy(e->{name} + {start}, out + {first}, sizeof(double) * {size});\n"
            first += size
        sticks = [int(part.prior.sticks) for part in self.parts for _ in range(part.components)]
        starts = accumulate((each.size for each in x), initial=0)
        rows = [(start, *each.shape) for start, each in zip(starts, x, strict=False)]
        laws: dict[str, object] = {name.lower(): repr(getattr(law, name)) for name in LAW}
        return laws | {
            "outputs": len(outputs),
            "copies": copies,
            "priors": len(self.parts),
            "waves": MISSED_FEATURES,
            "no_friction": NO_FRICTION,
            "sticks": ", ".join(map(str, sticks)),
            "first": ", ".join(map(str, self.starts)),
            "inputs": ", ".join(f"{{{a}, {b}, {c}}}" for a, b, c in rows),
        }

    def _operator(self, part: Functions, start: int) -> list[str]:
        """Return the code for E(x), which maps f to generalized forces (inertial errors: `controller.c`)."""
        prior, E = part.prior, f"f->E + {start}"
        if isinstance(prior, InertialPrior | PayloadPrior | DrivePrior):
            return []
        if isinstance(prior, contact.NormalForcePrior):
            return [f"  along_constraint(e, {E});"]
        if not isinstance(
            prior, contact.ContactForcePrior | contact.SlidingFrictionPrior | contact.CoulombErrorPrior
        ):
            free = (~self.model.system.robot.driven).nonzero()[:, 0].tolist()
            free = free if isinstance(prior, PerJointPrior) and prior.needs_drive else []
            return [f"  identity({part.components}, {E});", *(f"  ({E})[{j}][{j}] = 0.0;" for j in free)]
        c = self.model.system.contact_names.index(prior.contact)
        if isinstance(prior, contact.CoulombErrorPrior):
            law = next(x for x in prior.friction if x.contact == prior.contact)
            numbers = f"{float(law.coefficient)!r}, {float(law.smoothing)!r}"
            return [f"  friction_error(e, {c}, {numbers}, {E});"]
        if not isinstance(prior, contact.SlidingFrictionPrior):
            return [f"  tangential(e, {c}, {E});"]
        terms = self.array([contact.TERMS.index(term) for term in prior.terms], kind="int")
        numbers = (prior.smoothing, prior.friction_coefficient, prior.stribeck_speed, prior.torsion_smoothing)
        called = f"against(e, qd, {c}, {terms}, {len(prior.terms)}, {', '.join(map(repr, numbers))}, {E})"
        return [f"  if (! {called}) return 1;"]

    def _functions(self, p: int, part: Functions) -> list[str]:
        """Return the code for the functions V of each component and for their posterior."""
        before = self.mean.phi[:p]
        lines, m, first = [], part.size, sum(len(phi) for features in before for phi in features)
        kernel = KernelCode(self, p, lines, f"e->x + {sum(x.size for x in self.mean.x[:p])}")
        for k, phi in enumerate(self.mean.phi[p]):
            value, variance = ("", "0.0") if part.rest is None else kernel.covariance(part.rest, k)
            lines += [f"  {{\n    double V[{part.weights.shape[1] or 1}];"]
            if m:
                lines.append(f"    for (int j = 0; j < {m}; ++j) V[j] = {value};")
            lines += [f"    V[{m + i}] = e->phi[{first + i}];" for i in range(len(phi))]
            first += len(phi)
            white, kept = "0", 0
            if part.whitening is not None and m:
                white, kept = self.array(part.whitening[k].flatten()), part.whitening[k].shape[1]
            # Rows of C begin and end at multiples of `LANES`.
            root = torch.zeros(1)
            if self.touched[self.starts[p] + k]:
                filled, begin = torch.tensor(self.kept), part.first[k]
                padding = sum(self.kept[:begin]) % LANES, self.width - sum(self.kept)
                root = torch.nn.functional.pad(part.roots[k][:, filled[begin:]], padding)
            tables = [self.array(part.weights[k]), white, str(kept), self.array(root.flatten())]
            self.tables.append(tables)
            rest = f"{', '.join(tables[:3])}, spread, {self.starts[p] + k}, f"
            lines.append(f"    component(V, {m}, {len(phi)}, {variance}, {rest});\n  }}")
        return lines

    def _slopes(self) -> list[str]:
        """Return the code for the part of the mean of f with support points, and for its derivatives in x."""
        texts, calls, first, start = [], "", 0, 0
        for p, part in enumerate(self.parts):
            if not part.size or part.rest is None:
                continue
            lines, width = list[str](), self.mean.x[p].shape[1]
            kernel = KernelCode(self, p, lines, f"e->x + {sum(x.size for x in self.mean.x[:p])}", True)
            for k in range(part.components):
                value = kernel.covariance(part.rest, k)[0]
                lines += kernel.slopes(part.rest, k, value, f"f + {first + k}", f"slope + {start}")
                start += width
            title = f"/* {_comment(part.prior.name)}: f and df/dx */\n"
            title += f"static void slopes_{p}({SLOPES}) {{\n"
            texts.append(title + "\n".join(lines) + "\n}\n")
            calls += f"  slopes_{p}(e, f, slope);\n"
            first += part.components
        unread = "  (void)e, (void)f;\n  memset(slope, 0, sizeof(double) * SLOPES);\n"
        return [*texts, f"static void all_slopes({SLOPES}) {{\n{unread + calls}}}\n"]


class Leaf(NamedTuple):
    """A kernel with support points in C: its array `u`, the table of support points, the columns and factors
    of its inputs, its own factor `size`, and its bias.
    """

    u: str
    table: str
    columns: list[int]
    scale: list[float]
    size: float
    bias: float


class KernelCode:
    """C code for the kernel of one prior. The terms of a leaf are computed once before they are used."""

    def __init__(self, writer: Writer, p: int, lines: list[str], x: str, differentiate: bool = False) -> None:
        self.writer, self.part, self.lines = writer, writer.parts[p], lines
        self.differentiate = differentiate
        rows, self._width = writer.mean.x[p].shape
        self.shared = rows == 1 and all(z.ndim == 2 for z in self.part.support.values())
        self._known: dict[tuple[int, int], Leaf] = {}
        lines.append(f"  const double *const x = {x};\n  (void)x;")

    def covariance(self, part: KernelPart, k: int) -> tuple[str, str]:
        """Return C expressions for k(x, z_j) and k(x, x) of component k."""
        kernel, params = part.kernel, part.params
        if isinstance(kernel, kernels.Sum):
            (a, aa), (b, bb) = (self.covariance(KernelPart(*side), k) for side in kernel.parts(params))
            sign = "*" if isinstance(kernel, kernels.Product) else "+"
            return f"({a} {sign} {b})", f"({aa} {sign} {bb})"
        if isinstance(kernel, kernels.Constant):
            value = repr(float(row_of(kernel.std(params), k).square()))
            return value, value
        leaf = self._leaf(part, k)
        if isinstance(kernel, kernels.Stationary):
            return f"{leaf.size!r} * {leaf.u}[j]", repr(leaf.size)
        square = " + ".join(f"({a}) * ({a})" for a in self._x(leaf, k))
        both = (f"({leaf.size!r} * {x} + {leaf.bias!r})" for x in (f"{leaf.u}[j]", f"({square})"))
        return next(both), next(both)

    def slopes(self, part: KernelPart, k: int, value: str, f: str, slope: str) -> list[str]:
        """Return the code for f = Σ w_j k(x, z_j) and ∂f/∂x for component k."""
        m, w = self.part.size, self.writer.array(self.part.weights[k])
        lines = [f"  {{\n    double h[{m}];\n    for (int j = 0; j < {m}; ++j) h[j] = {value};"]
        lines.append(f"    *({f}) = dot(h, {w}, {m});")
        for leaf, stationary, factor in self._leaves(part, k, ""):
            column, scale = self.writer.array(leaf.columns, kind="int"), self.writer.array(leaf.scale)
            by = f" * d_{leaf.u}[j]" if stationary else ""
            lines.append(f"    for (int j = 0; j < {m}; ++j) h[j] = {w}[j] * {leaf.size!r}{by}{factor};")
            rest = f"{scale}, {column}, {len(leaf.columns)}, {m}, h, {int(stationary)}, {slope}"
            lines.append(f"    pull({leaf.table}, x_{leaf.u}, {rest});")
        return [*lines, "  }"]

    def _leaves(self, part: KernelPart, k: int, factor: str) -> Iterable[tuple[Leaf, bool, str]]:
        """Yield the leaves of a kernel that depend on x, each with the factor that multiplies it."""
        if isinstance(part.kernel, kernels.Sum):
            sides = [KernelPart(*side) for side in part.kernel.parts(part.params)]
            for side, other in zip(sides, sides[::-1], strict=True):
                product = isinstance(part.kernel, kernels.Product)
                more = f" * {self.covariance(other, k)[0]}" if product else ""
                yield from self._leaves(side, k, factor + more)
        elif not isinstance(part.kernel, kernels.Constant):
            yield self._leaf(part, k), isinstance(part.kernel, kernels.Stationary), factor

    def _leaf(self, part: KernelPart, k: int) -> Leaf:
        """Return a local array over the support points that contains xᵀz_j or a profile of |x − z_j|."""
        kernel, params = part.kernel, part.params
        if isinstance(kernel, kernels.Linear):
            # k = Σ_d (s σ_d)² x_d x′_d + σ_0²
            bias, common = float(row_of(kernel.bias_std(params), k).square()), kernel.shared and self.shared
            size = float((2.0 * params["log_std"][k]).exp()) if common else 1.0
            scale = params["log_slope_std"][0].exp() if common else row_of(kernel.slope_std(params), k)
            key, kind = (id(params["log_slope_std"]), 0 if common else k), "combine"
        else:
            assert isinstance(kernel, kernels.Stationary)
            bias, size = 0.0, float(row_of((2.0 * params["log_std"]).exp(), k))
            inverse, kind = torch.exp(-params["log_lengthscale"]), type(kernel).__name__.lower()
            scale = row_of(inverse, k)
            key = (id(params["log_lengthscale"]), 0 if self.shared and len(inverse) == 1 else k)
        if key not in self._known:
            columns = self.part.columns(kernel.inputs)
            z, u = stacked(self.part.support, kernel.inputs), f"u{len(self._known)}"
            Z = (z if z.ndim == 2 else z[k]) * scale
            table = self.writer.array(Z.mT.flatten()) if len(Z) else ""
            self._known[key] = Leaf(u, table, columns, scale.expand(len(columns)).tolist(), size, bias)
            self.lines += self._array(self._known[key], kind, k)
        return self._known[key]._replace(size=size, bias=bias)

    def _x(self, leaf: Leaf, k: int) -> list[str]:
        """Return the inputs of a leaf, each multiplied by its factor."""
        first = 0 if self.shared else k * self._width
        return [f"{s!r} * x[{first + c}]" for c, s in zip(leaf.columns, leaf.scale, strict=True)]

    def _array(self, leaf: Leaf, kind: str, k: int) -> list[str]:
        """Return the code that computes the array of a leaf."""
        u, m, x = leaf.u, self.part.size, self._x(leaf, k)
        if not m:
            return []
        lines = [f"  const double x_{u}[] = {{{', '.join(x)}}};\n  double {u}[{m}];"]
        if kind == "combine":
            return [*lines, f"  combine({leaf.table}, x_{u}, {len(x)}, {m}, {u});"]
        lines.append(f"  squares(x_{u}, {leaf.table}, {len(x)}, {m}, {u});")
        if self.differentiate:
            lines.append(f"  double d_{u}[{m}];\n  memcpy(d_{u}, {u}, sizeof {u});")
            lines.append(f"  {kind}_slope(d_{u}, {m});")
        return [*lines, f"  {kind}({u}, {m});"]
