"""The numbers of a fitted model that its C code contains: the functions of each prior and the posterior.

The posterior covariance of the latent forces f is D ± T Tᵀ, with diagonal D and a row V(x)ᵀ C in T for each
component. The functions V are covariances k(x, X) with support points, and features φ(x) of the finite part
of the kernel. For a posterior over basis functions with weights of precision A = L Lᵀ, V is whitened, C =
L⁻ᵀ, and D is the residual variance given the support points. For an exact posterior with Σ = L Lᵀ, C = Wᵀ
L⁻ᵀ, D = k(x, x), and the sign is −. A posterior reduced to r functions also has D = k(x, x) and the sign −.
It uses A⁻¹ = I − U (1 − Λ⁻¹) Uᵀ with the r largest eigenvalues Λ of A, or Σ⁻¹ = U Λ⁻¹ Uᵀ with those of Σ. The
training data determine these directions best. A reduction only widens error bars and leaves the mean
unchanged.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import torch
from torch import Tensor
from torch.nn.functional import pad

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.errors import ModelError
from forcegp.forces.external_wrench import WrenchFrame
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors import contact, joint
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.constants import DrivePrior
from forcegp.forces.priors.inertial import InertialPrior, PayloadPrior
from forcegp.forces.priors.residual import ResidualPrior
from forcegp.forces.term import JointTerm
from forcegp.gp.basis import KernelPart, split
from forcegp.gp.exact import ExactPosterior
from forcegp.gp.features import Features, points
from forcegp.gp.kernels import (
    Columns,
    Constant,
    Kernel,
    Linear,
    Matern32,
    Matern52,
    SquaredExponential,
    Sum,
    sub,
)
from forcegp.gp.sparse import SparsePosterior
from forcegp.identification import base_parameters
from forcegp.robot.model import RobotModel

PRIORS = (joint.JointForcePrior, ResidualPrior, InertialPrior, PayloadPrior, DrivePrior)
PRIORS += (contact.NormalForcePrior, contact.SlidingFrictionPrior, contact.ContactForcePrior)
PRIORS += (contact.CoulombErrorPrior,)
KERNELS = (Linear, Columns, Constant, SquaredExponential, Matern32, Matern52)
WHY = {
    "OperatorForcePrior": "its operator is Python code",
    "PayloadPrior": "it has a known payload, but the code contains only the mechanics of the bare arm",
    "ImplicitSurface": "it is Python code",
}
"""Reasons why a type has no C form. Other types have no C form yet."""
LARGEST = 1700
"""Maximum number of functions of a posterior that is not reduced: about 30 MB of text, which a compiler
translates in half a minute."""
REDUCED = 200
"""Number of functions that the covariance of a larger posterior keeps in an export, if no number is given. It
is the number that the error of `check` recommends; each export measures what it loses. At the training states
of 310 samples of `kuka_plane` (1860 rows), σ grows by at most 0.06 %, with 100 functions by up to 100 %."""


@dataclass(frozen=True, eq=False)
class Functions:
    """The functions V of one prior, and their posterior.

    Attributes:
        prior: the force prior.
        rest, finite: the parts of its kernel with support points and with features, or `None` if absent.
        support: standardized inputs of the m support points.
        weights: weights `(components, m + features)` of k(x, X) and φ in the posterior mean.
        whitening: a matrix `(m, kept)` that whitens k(x, X) for each component, or `None`.
        roots: the matrix C of each component, `(functions, rank − first)`.
        first: the first nonzero column for each component.
        parameters: for errors of base parameters, their columns in [Y, diag q̈].
    """

    prior: ForcePrior
    rest: KernelPart | None
    finite: KernelPart | None
    support: Features
    weights: Tensor
    whitening: tuple[Tensor, ...] | None
    roots: tuple[Tensor, ...]
    first: tuple[int, ...]
    parameters: tuple[int, ...] = ()

    @property
    def components(self) -> int:
        """Number of components of the latent force."""
        return len(self.weights)

    @property
    def rank(self) -> int:
        """Number of columns of T."""
        return self.first[0] + self.roots[0].shape[1]

    @property
    def size(self) -> int:
        """Number m of support points."""
        return 0 if self.rest is None else points(self.support)

    def inertial(self, robot: RobotModel) -> tuple[list[int], Tensor]:
        """Return the columns of [Y, diag q̈] that errors of inertia multiply, and the units of the errors."""
        if self.parameters:
            return list(self.parameters), torch.ones(len(self.parameters), dtype=torch.float64)
        assert isinstance(self.prior, InertialPrior)
        units = self.prior.scale(robot)
        return list(range(len(units))), units

    def columns(self, names: Sequence[str] | None) -> list[int]:
        """Return the columns of the named inputs, or of all inputs."""
        widths = {name: x.shape[-1] for name, x in self.support.items()}
        starts = dict(zip(widths, accumulate(widths.values(), initial=0), strict=False))
        chosen = widths if names is None else names
        return [starts[name] + i for name in chosen for i in range(widths[name])]


@dataclass(frozen=True, eq=False)
class ExportedModel:
    """The exported part of a fit.

    Attributes:
        system: the robot and its contacts.
        posterior: the posterior over the latent forces.
        tensors: all hyperparameters.
        noise: standard deviation of the noise for each measured quantity.
        torque_std, external_std: standard deviations of torque noise and of unknown joint forces, or `None`.
        functions: number r of functions in a reduced-rank covariance. `None` means all functions, and 0 means
            that only the mean is exported.
        sampling: for samples learned online, the variance of the torque noise `(nq,)`, the exponent κ of the
            likelihood, and whether samples must be in motion. `None` if it does not learn online.
        wrench: the frame and components of an external wrench to estimate, or `None`.
        dtype: precision of the C code.
        never_closed: contacts that are never closed in the training data.
        jacobians: whether to export Jacobians of the mean.
    """

    system: ConstrainedSystem
    posterior: ForcePosterior
    tensors: Mapping[str, Tensor]
    noise: Mapping[str, Tensor]
    torque_std: Tensor | None
    external_std: Tensor | None
    functions: int | None = None
    sampling: tuple[Tensor, float, bool] | None = None
    wrench: WrenchFrame | None = None
    dtype: torch.dtype = torch.float64
    never_closed: tuple[str, ...] = ()
    jacobians: bool = True

    @property
    def reads_contacts(self) -> bool:
        """Whether the code reads contact forces off accelerations, which single precision cannot resolve."""
        return bool(self.system.contacts) and self.dtype == torch.float64

    @property
    def online(self) -> bool:
        """Whether the model can learn online, which requires basis functions with their full covariance.

        The torque must not be delayed.
        """
        timely = not any(prior.delay for prior in self.posterior.priors)
        return self.sign > 0 and timely and self.sampling is not None

    def check(self) -> None:
        """Check that all parts of the model have a C form.

        Raises:
            ModelError: a prior, kernel, contact or mean has no C form, or the posterior is too large.
            UnknownNameError: the frame of the external wrench does not exist.
        """
        if self.dtype not in (torch.float64, torch.float32):
            raise ModelError("invalid precision of C code", expected="float64 or float32", got=self.dtype)
        if self.wrench is not None:
            self.system.robot.frame_index(self.wrench.frame)
            if self.dtype != torch.float64:
                raise ModelError(
                    "an external wrench needs double precision", hint="M q̈ − Q̄ loses digits to cancellation"
                )
        if self.system.robot.device.type != "cpu":
            raise ModelError("a fit on a GPU cannot be exported", hint="save it, and load it on the CPU")
        self.system.robot.check_own_drives("an exported program")
        for each in self.system.contacts:
            if not isinstance(each, SurfaceContact) or each.stick_speed is not None:
                raise _no_c("contact", each.name, each, "a SurfaceContact that always slides")
            if not each.surface.has_scalars:
                expected = "a surface with `scalars`, such as a plane"
                raise _no_c("surface of contact", each.name, each.surface, expected)
        if not isinstance(self.posterior.process.mean, joint.AnalyticalMean):
            raise _no_c("mean", "Q", self.posterior.process.mean, "an AnalyticalMean")
        for prior in self.posterior.priors:
            law = isinstance(prior, JointTerm) or type(prior) in PRIORS
            if not law or (isinstance(prior, PayloadPrior) and prior.known):
                raise _no_c("force prior", prior.name, prior, ", ".join(x.__name__ for x in PRIORS))
            _check_kernel(prior.name, prior.kernel)
        for kind, what in ((InertialPrior, "the inertia"), (PayloadPrior, "a payload")):
            if sum(isinstance(prior, kind) for prior in self.posterior.priors) > 1:
                raise ModelError(
                    f"a fit with two priors on {what} cannot be exported", expected="at most one"
                )
        if self.functions is None and self.size > LARGEST:
            raise ModelError(
                f"a posterior over {self.size} functions is too large for C code",
                expected=f"at most {LARGEST}",
                hint="reduce its covariance with functions=200 (--functions 200)",
            )

    @property
    def size(self) -> int:
        """Number of basis functions or training rows of the posterior."""
        latent = self.posterior.latent
        return latent.basis.size if isinstance(latent, SparsePosterior) else len(latent.alpha)

    def reduced(self) -> ExportedModel:
        """Return the model with `REDUCED` functions if the posterior is too large and no number is given."""
        too_large = self.functions is None and self.size > LARGEST
        return dataclasses.replace(self, functions=REDUCED) if too_large else self

    @property
    def sign(self) -> int:
        """Sign of T Tᵀ in the covariance."""
        return 1 if isinstance(self.posterior.latent, SparsePosterior) and self.functions is None else -1

    def parts(self) -> list[Functions]:
        """Functions of each prior, and their posterior."""
        if isinstance(self.posterior.latent, SparsePosterior):
            return self._of_basis(self.posterior.latent)
        return self._of_rows(self.posterior.latent)

    def parts_of_motion(self) -> list[Functions]:
        """Functions of each prior, with errors of base parameters instead of all inertial parameters.

        The posterior of the forces is the same. If the sign of T Tᵀ is negative, D is diagonal only for
        errors of all parameters, and these are returned, as for a model that learns online, with priors on
        independent errors.
        """
        parts = self.parts()
        p = next((p for p, part in enumerate(parts) if isinstance(part.prior, InertialPrior)), None)
        if p is None or self.sign < 0 or self.online:
            return parts
        part, (B, parameters) = parts[p], _acting_errors(parts[p], self.system.robot)
        C = [pad(C, (x, 0)) for part in parts for C, x in zip(part.roots, part.first, strict=True)]
        at = sum(len(part.roots) for part in parts[:p])
        C[at : at + B.shape[1]] = errors = (B @ torch.cat(C[at : at + B.shape[1]])).split(1)
        one = KernelPart(Constant(), {"log_scale": B.new_zeros(len(B))})
        changes = {"weights": B @ part.weights, "finite": one, "roots": errors, "parameters": parameters}
        parts[p] = dataclasses.replace(part, **changes)
        # C Cᵀ = R Rᵀ with an upper triangular R, whose rows keep their columns.
        surplus = [part.first[0] + k for k in range(B.shape[1]) if k not in parameters]
        order = surplus + [i for i in range(part.rank) if i not in surplus]
        R = torch.linalg.qr(torch.cat(C)[:, order].flip(0, 1).mT, mode="r").R.mT.flip(0, 1)
        first = 0
        for i, part in enumerate(parts):
            starts = list(accumulate(map(len, part.roots), initial=first))
            roots = tuple(R[a:b, a:] for a, b in pairwise(starts))
            parts[i] = dataclasses.replace(part, roots=roots, first=tuple(starts[:-1]))
            first = starts[-1]
        return parts

    def _of_basis(self, latent: SparsePosterior) -> list[Functions]:
        basis, parts = latent.basis, []
        if self.functions is None:
            eye = torch.eye(len(latent.L), dtype=latent.L.dtype)
            # C = L⁻ᵀ, upper triangular
            C = torch.linalg.solve_triangular(latent.L, eye, upper=False).mT
        elif not self.functions:
            C = latent.L.new_zeros(len(latent.L), 1)
        else:
            # C = U √(1 − Λ⁻¹)
            values, vectors = torch.linalg.eigh(latent.L @ latent.L.mT)
            kept = slice(-self.functions, None)
            C = vectors[:, kept] * (1.0 - 1.0 / values[kept]).clamp(min=0.0).sqrt()
        for p, (part, components) in enumerate(zip(basis.parts, basis.components, strict=True)):
            columns = basis.columns[components]
            on_kernel, on_features = latent.folded[p]
            weights = torch.cat([on_kernel, on_features], dim=1)[..., 0]
            first = tuple(rows.start if self.functions is None else 0 for rows in columns)
            roots = [C[rows, start:] for rows, start in zip(columns, first, strict=True)]
            whitening = tuple(spectrum.root for spectrum in part.spectra) or None
            if self.functions is not None and whitening is not None:
                pairs = zip(roots, whitening, strict=True)
                roots = [torch.cat([R @ x[: R.shape[1]], x[R.shape[1] :]]) for x, R in pairs]
                whitening = None
            support = part.inducing if part.to_inducing is not None else _none(part.inducing)
            prior, (finite, rest) = self.posterior.priors[p], (part.split.finite, part.split.rest)
            parts.append(Functions(prior, rest, finite, support, weights, whitening, tuple(roots), first))
        return parts

    def _of_rows(self, latent: ExactPosterior) -> list[Functions]:
        L, weights, parts = latent.conditioned.L, latent.weights, []
        if self.functions is None:
            rows = torch.linalg.solve_triangular(L, torch.eye(len(L), dtype=L.dtype), upper=False).mT
        elif not self.functions:
            rows = L.new_zeros(len(L), 1)
        else:
            values, vectors = torch.linalg.eigh(L @ L.mT)
            rows = vectors[:, -self.functions :] * values[-self.functions :].rsqrt()
        for p, roots in enumerate(latent.weights_of(rows)):
            prior = self.posterior.priors[p]
            cut = split(prior.kernel, sub(latent.params, latent.processes[p].prefix))
            names = latent.blocks[0].features[p]
            X = {name: torch.cat([block.features[p][name] for block in latent.blocks]) for name in names}
            # k(x, X) w = k_rest(x, X) w + φ(x)ᵀ (φ(X)ᵀ w), and likewise for C = Wᵀ L⁻ᵀ
            both = torch.cat([torch.cat(weights[p], dim=1), torch.cat(roots, dim=1)], dim=-1)
            on_rest = both if cut.rest is not None else both[:, :0]
            on_features = both[:, :0]
            if cut.finite is not None:
                on_features = cut.finite.features(X).basis(X).mT @ both
            whole = torch.cat([on_rest, on_features], dim=1)
            support = X if cut.rest is not None else _none(X)
            C, first = tuple(whole[..., 1:]), (0,) * len(whole)
            parts.append(Functions(prior, cut.rest, cut.finite, support, whole[..., 0], None, C, first))
        return parts


def _acting_errors(part: Functions, robot: RobotModel) -> tuple[Tensor, tuple[int, ...]]:
    """Return B, which maps the weights of errors of inertia to errors of base parameters and drives.

    The second value contains the columns of these parameters in [Y, diag q̈].
    """
    base, units = base_parameters(robot), part.inertial(robot)[1]
    assert part.finite is not None and isinstance(part.finite.kernel, Constant)
    links = base.combination.shape[1]
    drives = links + units[links:].nonzero()[:, 0]
    of_links = pad(torch.from_numpy(base.combination), (0, len(units) - links))
    B = torch.cat([of_links, torch.eye(len(units), dtype=of_links.dtype)[drives]])
    return B * units * part.finite.kernel.std(part.finite.params), (*base.columns, *drives.tolist())


def row_of(x: Tensor, k: int) -> Tensor:
    """Return the row of component k, or the row that all components share."""
    return x[k if len(x) > 1 else 0]


def _none(features: Features) -> Features:
    return {name: x[:0] for name, x in features.items()}


def _check_kernel(name: str, kernel: Kernel) -> None:
    if isinstance(kernel, Sum):
        _check_kernel(name, kernel.left)
        _check_kernel(name, kernel.right)
    elif type(kernel) not in KERNELS:
        raise _no_c("kernel of force prior", name, kernel, ", ".join(x.__name__ for x in KERNELS))


def _no_c(what: str, name: str, thing: object, expected: str) -> ModelError:
    kinds = [kind.__name__ for kind in type(thing).__mro__]
    why = next((WHY[kind] for kind in kinds if kind in WHY), "its type has no C form")
    return ModelError(
        f"the {what} {name!r} cannot be exported as C: {why}",
        expected=expected,
        got=type(thing).__name__,
        hint="predict in Python, or leave it out of the model",
    )
