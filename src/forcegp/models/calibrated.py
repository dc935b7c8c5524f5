"""The robot identified by a fit, with parameters that robot files support, and posterior samples of it.

URDF supports joint friction only in the form d q̇ + f sign q̇. The coefficients d and f are therefore
fitted to the learned friction Q_D(q̇) over the trained speeds by least squares, with an offset c:

    min Σ_v (Q_D(v) + d v + f sign v − c)²,   d, f ≥ 0.

MJCF also supports polynomial damping and friction with memory (`friction_law.py`). If friction depends on the
load, Q_D is averaged over poses. The residual and the offset c are lost. Logs rarely separate an offset from
the gravity force of the links. If an offset is within 2σ of zero, all other parameters are therefore
conditioned on c = 0. URDF does not support armature, so drive inertia is added to the links as far as
physically possible. Samples are computed in the same way from functions drawn from the posterior, with
inertial parameters π + S δ (`forces/priors/inertial.py`). If the inertia was identified first, there are two
estimates, which differ by b. The robot lies halfway between them, and samples are spread by N(0, ¼ b bᵀ) in
addition: mean and covariance of an estimate that is either one with probability ½.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import lsq_linear
from torch import Tensor

from forcegp import dynamics
from forcegp.control.information import PLACES, Unknowns
from forcegp.destination import check_destination, check_kept
from forcegp.errors import ModelError, ParameterError
from forcegp.files import write_json
from forcegp.forces.posterior import HIGH, LOW, ForceSamples
from forcegp.forces.priors.constants import DrivePrior
from forcegp.forces.priors.inertial import InertialPrior, PayloadPrior
from forcegp.forces.priors.joint import AnalyticalMean
from forcegp.forces.priors.memory import BristlePrior
from forcegp.forces.quantities import States, states_at
from forcegp.forces.term import JointTerm
from forcegp.identification import regressor
from forcegp.models.friction_law import RATE, Laws, Reversals, laws_of
from forcegp.models.parameters import SCALE, is_identified
from forcegp.models.robot_parameters import MOMENTS
from forcegp.models.structured_fit import StructuredFit
from forcegp.robot.inertia import from_pseudo_inertia, inertial_parameters, pseudo_inertia, pseudo_inertia_of
from forcegp.robot.model import RobotModel
from forcegp.robot.write_back import BRISTLE, DRAG, is_mjcf, per_joint, write_robot

SPEEDS, POSES = 20, 20
"""Number of speeds in each direction, and number of poses, at which friction is evaluated."""
SLOWEST_SHARE = 0.05
"""Smallest of these speeds relative to the largest trained speed. Dry friction is smoothed below it."""
UNTRAINED = 1.0
"""Largest speed that is assumed if the trained speeds are unknown [rad/s, m/s]."""
DRAWS, DRAWN = 400, 4000
"""Number of function samples from which standard deviations are computed, and from which covariances are."""
UNDETERMINED_STDS = 2.0
"""Number of standard deviations from zero within which an offset counts as undetermined."""
DETERMINED = 0.5
"""Standard deviation, relative to the prior's or to the value, below which a parameter is determined."""
SMALLEST = 1e-2
"""Smallest eigenvalue ε of a link's pseudo-inertia relative to the identified pseudo-inertia."""
ROUNDS, RELAXATION = 300, 1.6
"""Number of iterations and over-relaxation of the search for the closest physical bodies."""
STATES = 400
"""Number of random states used to add drive inertia to links."""
WANTED = 0.01
"""Target relative torque error ε."""
FIGURES = ("damping", "friction", *MOMENTS, "armature")
LAW = (*DRAG, *BRISTLE[1:])
"""Names of the parameters of a joint, and of those of friction that only MJCF supports."""


@dataclass(frozen=True)
class Parameter:
    """An identified parameter of the robot.

    Attributes:
        element: name of the joint. Inertial parameters are those of the link that the joint moves.
        name: name of the parameter.
        file, estimate, std: value in the file, estimate, and standard deviation in SI units.
        determined: whether the data determine the parameter more precisely than the prior.
    """

    element: str
    name: str
    file: float
    estimate: float
    std: float
    determined: bool


@dataclass(frozen=True, eq=False)
class Calibration:
    """The robot identified by a fit.

    Attributes:
        robot: the robot with the identified inertia, and with friction in a form that robot files support.
        parameters: the changed parameters with their values in the file and their standard deviations.
        speeds, friction, friction_std: speeds [rad/s, m/s], learned friction of each joint and its standard
            deviation [N m, N], each `(k, nq)`.
        left: RMS friction that the robot does not have, `(nq,)` [N m, N].
        offset: additional constant force, `(nq,)` [N m, N].
        levels, levels_std: static and dynamic dry friction at low and at high speed, `(2, nq)` [N m, N].
    """

    robot: RobotModel
    parameters: tuple[Parameter, ...]
    speeds: Tensor
    friction: Tensor
    friction_std: Tensor
    left: Tensor
    offset: Tensor
    levels: Tensor
    levels_std: Tensor

    @property
    def losses(self) -> tuple[str, ...]:
        """Learned forces that a robot file cannot represent, described by one sentence per joint."""
        rms, offset = (x.round(decimals=9).tolist() for x in (self.left, self.offset))  # no rounding errors
        texts = "friction beyond that of the file of {:.3g} (root mean square)", "a constant force of {:.3g}"
        sentences = []
        for joint, *sizes in zip(self.robot.joint_names, rms, offset, strict=True):
            parts = [text.format(size) for text, size in zip(texts, sizes, strict=True) if size]
            sentences += [f"joint {joint!r}: {' and '.join(parts)} (N m or N)"] if parts else []
        return tuple(sentences)


@torch.no_grad()
def calibrated(
    fit: StructuredFit, *, draws: int = DRAWS, seed: int = 0, gain_std: float = 0.0, mjcf: bool = False
) -> Calibration:
    """Return the robot with the identified inertia and payload, and with friction that robot files support.

    Args:
        fit: a fit with an analytical mean.
        draws: number of function samples from which standard deviations are computed.
        seed: random seed for these samples, whose covariance weights the links that are made physical, and
            for the poses over which friction is averaged. Estimates depend on both within their bars.
        gain_std: relative standard deviation of the torque sensors' gains, which no log determines. The
            resulting errors of the identified inertia are included in its standard deviations.
        mjcf: whether friction has the form of MJCF, with polynomial damping and memory, or else of URDF.

    Returns:
        The robot, its parameters with standard deviations, and the losses.

    Raises:
        ModelError: the fit has no analytical mean, or `gain_std` is given for inertia not identified by
            `inertia="auto"`.

    Example:
        `write_robot(calibrated(fit).robot, "my.urdf", "calibrated.urdf")`
    """
    reader = _Reader.of(fit, seed, gain_std=gain_std)
    (mean, *samples), laws = reader.robots(draws, mjcf)
    file = fit.specified.robot
    robot, (curve, residual, offset) = mean
    curves = torch.stack([sampled for _, (sampled, _, _) in samples])
    # Scales remain those that instruments found, and undetermined ones nominal.
    robot = robot.replace(torque_scale=fit.system.robot.torque_scale)
    robots = [each for each, _ in samples]
    parameters = (*_parameters(file, robot, robots, reader.scale, mjcf), *_torque_scales(fit, robot))
    dry = torch.from_numpy(laws.values[..., 3:5].sum(-1)), torch.from_numpy(laws.values[..., 3])
    levels, std = (
        torch.stack(each).to(curve) for each in zip(*((x[0], x[1:].std(0)) for x in dry), strict=True)
    )
    return Calibration(robot, parameters, reader.speeds, curve, curves.std(0), residual, offset, levels, std)


@torch.no_grad()
def sampled_robots(
    fit: StructuredFit, samples: int, *, seed: int = 0, gain_std: float = 0.0, mjcf: bool = False
) -> list[RobotModel]:
    """Draw physically consistent robots from the joint posterior of inertia, drives, payload and friction.

    A sample with unphysical links is replaced by the closest physical robot in the metric of the posterior.
    Relative to the identified pseudo-inertias, the new ones have eigenvalues of at least ε = 0.01.

    Args:
        fit: a fit with an analytical mean.
        samples: number of robots.
        seed: random seed.
        gain_std, mjcf: see `calibrated`.

    Raises:
        ModelError: see `calibrated`.
        ParameterError: `samples` is below one.
    """
    if samples < 1:
        raise ParameterError("invalid number of samples", expected="1 or more", got=samples)
    reader = _Reader.of(fit, seed, gain_std=gain_std)
    return [robot for robot, _ in reader.robots(max(samples, DRAWS), mjcf)[0][1 : 1 + samples]]


def write_calibrated(
    fit: StructuredFit,
    source: str | Path,
    out: str | Path,
    *,
    samples: int = 0,
    seed: int = 0,
    gain_std: float = 0.0,
    locked_joints: Mapping[str, float] | None = None,
) -> Calibration:
    """Write a copy of the robot file with the identified parameters, a report, and sampled robots.

    For `calibrated.urdf`, for example, the report is `calibrated.report.json`. It contains the parameters,
    the losses and the complete friction curves. The samples are `calibrated.sample_000.urdf` and so on.

    Args:
        fit: a fit with an analytical mean.
        source: the robot file, or the name of a bundled robot.
        out: path of the edited copy.
        samples: number of robots to draw from the posterior.
        seed: random seed.
        gain_std: see `calibrated`.
        locked_joints: see `load_robot`.

    Raises:
        DestinationError: one of the files would replace the robot file or a folder, or cannot be written.
        RobotFileError: the file does not match the robot, or cannot represent a change.
        ModelError: see `calibrated`.
    """
    out = Path(out)
    *paths, page = results = written_files(out, samples)
    check_kept(results, [Path(source)])
    for path in results:
        check_destination(path)
    mjcf = is_mjcf(source)
    calibration = calibrated(fit, seed=seed, gain_std=gain_std, mjcf=mjcf)
    drawn = sampled_robots(fit, samples, seed=seed, gain_std=gain_std, mjcf=mjcf) if samples else []
    robots = [calibration.robot, *drawn]
    drives = not mjcf and bool((calibration.robot.armature != 0.0).any())
    losses: tuple[str, ...] = ()
    for robot, path in zip(robots, paths, strict=True):
        holding = without_armature(robot, calibration.speeds[-1]) if drives else robot
        losses = losses or write_robot(holding, source, path, locked_joints=locked_joints).losses
    if drives:
        values = ", ".join(f"{x:.4g}" for x in calibration.robot.armature.tolist())
        losses = (
            f"URDF has no armature ({values}): the links include its inertia as far as physically possible",
            *losses,
        )
    report = {
        "parameters": [vars(parameter) for parameter in calibration.parameters],
        "losses": [*losses, *calibration.losses],
        "dry_friction": {
            joint: {
                name: {"value": float(calibration.levels[k, j]), "std": float(calibration.levels_std[k, j])}
                for k, name in enumerate(("static", "dynamic"))
            }
            for j, joint in enumerate(calibration.robot.joint_names)
        },
        "friction": {
            joint: {
                "speed": calibration.speeds[:, j].tolist(),
                "force": calibration.friction[:, j].tolist(),
                "std": calibration.friction_std[:, j].tolist(),
            }
            for j, joint in enumerate(calibration.robot.joint_names)
        },
    }
    write_json(page, report)
    return calibration


def written_files(out: Path, samples: int) -> list[Path]:
    """Return the paths that `write_calibrated` writes: the robot, the samples, and the report."""
    drawn = [out.with_name(f"{out.stem}.sample_{k:03d}{out.suffix}") for k in range(samples)]
    return [out, *drawn, out.with_name(f"{out.stem}.report.json")]


@torch.no_grad()
def unknowns_after(fit: StructuredFit, unknowns: Unknowns, *, draws: int = DRAWS, seed: int = 0) -> Unknowns:
    """Return the unknowns for planning the next motion, based on functions drawn from a fit.

    Base parameters, payload and friction at each speed have the posterior covariance. Parameters without a
    prior in the fit keep their covariance from `unknowns`. The noise is at least the torque noise of the fit.

    Args:
        fit: a fit with an analytical mean.
        unknowns: the unknowns of the robot before any data were recorded.
        draws: number of function samples.
        seed: random seed for these samples.

    Raises:
        ModelError: see `calibrated`.
    """
    reader = _Reader.of(fit, seed, unknowns.fastest)
    drawn = fit.force_samples(draws, torch.Generator().manual_seed(seed))
    assert isinstance(drawn, ForceSamples)
    nq, links = unknowns.robot.nq, unknowns.base.rank
    deviations: dict[int, Tensor] = {}
    delta = reader.speeds.new_zeros(draws, nq * len(MOMENTS))
    prior = next((p for p in fit.force_priors if isinstance(p, InertialPrior)), None)
    if prior is not None:
        errors = reader._constants(drawn, InertialPrior)[1:] * prior.scale(unknowns.robot)
        delta += errors[:, : delta.shape[1]]
        deviations |= dict(enumerate(errors[:, delta.shape[1] :].mT, unknowns.parts["drives"].start))
    for payload in (p for p in fit.force_priors if isinstance(p, PayloadPrior)):
        first = len(MOMENTS) * payload.link(unknowns.robot)
        load = reader._constants(drawn, PayloadPrior)[1:] * payload.units(delta)
        delta[:, first : first + load.shape[1]] += load
    if prior is not None:
        deviations |= dict(enumerate((delta @ torch.from_numpy(unknowns.base.combination).mT).mT))
    if any(isinstance(prior, JointTerm) for prior in fit.force_priors):
        curves = reader._curves(drawn)[1:]
        basis = unknowns.basis(torch.zeros_like(reader.speeds), reader.speeds)
        spread, each = (curves - curves.mean(0)).permute(2, 1, 0), basis.shape[-1]
        weights = torch.linalg.pinv(basis[..., :-PLACES].movedim(1, 0)) @ spread
        deviations |= {links + each * j + k: w for j in range(nq) for k, w in enumerate(weights[j])}
    if not deviations:
        return unknowns
    rows, samples = list(deviations), torch.stack(list(deviations.values()))
    covariance, root = torch.cov(samples), unknowns.root.clone()
    jitter = JITTER * torch.diag(root[rows].square().sum(-1))
    root[rows] = 0.0
    root[torch.tensor(rows)[:, None], rows] = torch.linalg.cholesky(covariance + jitter)
    std = fit.torque_std
    noise = unknowns.noise if std is None else torch.maximum(std.to(unknowns.noise), unknowns.noise)
    return replace(unknowns, root=root, noise=noise)


JITTER = 1e-6
"""Jitter added to the covariance, relative to the prior variances."""
Curve = tuple[Tensor, Tensor, Tensor]
"""Friction at given speeds `(k, nq)`, the residual after fitting d q̇ + f sign q̇, and the offset `(nq,)`."""


@dataclass(frozen=True, eq=False)
class _Reader:
    """Computation of robots from a fit. The states `at` combine all poses with the `speeds` `(k, nq)`."""

    fit: StructuredFit
    speeds: Tensor
    at: States
    seed: int
    gain_std: float

    @classmethod
    def of(
        cls, fit: StructuredFit, seed: int, fastest: Tensor | None = None, gain_std: float = 0.0
    ) -> _Reader:
        mean = fit.problem.mean
        if not isinstance(mean, AnalyticalMean) or "actuation" not in mean.terms:
            raise ModelError(
                "the forces of this fit are not relative to the robot file",
                expected='a model with mean="analytical"',
                hint='fit StructuredGP(system, "analytical")',
            )
        robot, values = fit.system.robot, fit.hyperparameters
        robot.check_own_drives("a robot file")
        if fastest is None:
            fastest = torch.full_like(robot.mass, UNTRAINED)
            if LOW in values:
                fastest = torch.maximum(-values[LOW][0], values[HIGH][0]).clamp(min=1e-6)
        up = torch.linspace(SLOWEST_SHARE, 1.0, SPEEDS, dtype=robot.dtype, device=robot.device)
        speeds = torch.cat([-up.flip(0), up])[:, None] * fastest
        return cls(fit, speeds, cls._at(fit, speeds, seed), seed, gain_std)

    @staticmethod
    def _at(fit: StructuredFit, speeds: Tensor, seed: int) -> States:
        """Return the states of all poses at the given speeds."""
        robot = fit.system.robot
        low, high = (x.clamp(-np.pi, np.pi) for x in (robot.lower, robot.upper))
        generator = torch.Generator().manual_seed(seed)
        share = torch.rand(POSES, 1, robot.nq, generator=generator, dtype=robot.dtype)
        q = (low + share.to(robot.device) * (high - low)).expand(-1, len(speeds), -1).flatten(0, 1)
        qd = speeds.expand(POSES, -1, -1).flatten(0, 1)
        open_ = torch.zeros(len(q), len(fit.system.contacts), dtype=torch.bool, device=robot.device)
        return states_at(fit.system, q, qd, torch.zeros_like(q), open_)[0]

    @property
    def scale(self) -> Tensor | None:
        """Prior standard deviations of links and drives `(nq, 11)`, or `None` without identified inertia."""
        robot = self.fit.system.robot
        for prior in self.fit.force_priors:
            if isinstance(prior, InertialPrior):
                links = prior.scale(robot)[: robot.nq * len(MOMENTS)].view(-1, len(MOMENTS))
                drives = links.new_tensor(prior.drives or robot.nq * [0.0])
                return torch.cat([links, drives[:, None]], dim=-1)
        return None

    def robots(self, draws: int, mjcf: bool) -> tuple[list[tuple[RobotModel, Curve]], Laws]:
        """Return the robots for the posterior mean and for function samples, each with its friction curve,
        and the friction laws of their joints."""
        generator = torch.Generator().manual_seed(self.seed)
        drawn = self.fit.force_samples(max(draws, DRAWN), generator)
        assert isinstance(drawn, ForceSamples)
        curves = self._curves(drawn)
        inertia = self._constants(drawn, InertialPrior)
        inertia[1:] += self._gain_errors(drawn.count, generator)
        parts = [curves.flatten(1), inertia, *(self._constants(drawn, x) for x in (PayloadPrior, DrivePrior))]
        reversals = Reversals.of(self.speeds[-1])
        forces, apart = self._reversing(drawn, reversals)
        parts, b = [*parts, *(force.flatten(1) for force in forces)], [self._disagreement(), *apart]
        sizes, values, b = [part.shape[-1] for part in parts], torch.cat(parts, dim=-1), torch.cat(b, dim=-1)
        offset, kept = self._offsets(curves), self._offsets(self._kept()[None])
        gain = _offset_gain(offset, offset[0] - kept[0], values)
        apart = self._offsets(b[:, : sizes[0]].unflatten(1, self.speeds.shape))
        free, b = values - offset @ gain, b - apart @ gain
        random = torch.randn(draws, 1, generator=generator, dtype=torch.float64)
        # Mean and samples are those of the identified inertia, and the other estimate is b less.
        along = torch.cat([random.new_zeros(1, 1), random]).to(b)
        spread = free[: 1 + draws] + 0.5 * (along - 1.0) * b
        curves, *others = self._consistent(spread, sizes[0], free[1:]).split(sizes, dim=-1)
        rows = zip(curves.unflatten(1, self.speeds.shape), *others[:3], strict=True)
        robots = [self._robot(*row) for row in rows]
        # Friction resists, −Q.
        resisting = [-part.unflatten(1, (-1, self.speeds.shape[-1])) for part in others[3:]]
        laws = laws_of(reversals, *resisting)
        if mjcf:
            written = laws if laws.has_memory.all() else laws_of(reversals, *resisting, static=False)
            robots = self._with_laws(robots, written)
        return robots, laws

    def _reversing(self, drawn: ForceSamples, at: Reversals) -> tuple[list[Tensor], list[Tensor]]:
        """Return the arguments of `laws_of` as forces Q, and for each the difference of the identified
        inertia, `(1, k nq)`.
        """
        fit, speeds = self.fit, at.both
        sliding = replace(self, speeds=speeds, at=self._at(fit, speeds, self.seed))
        forces, apart = [sliding._curves(drawn)], [sliding._kept().flatten()[None]]
        for p in [p for p, prior in enumerate(fit.force_priors) if isinstance(prior, BristlePrior)]:
            qd, history = (x.chunk(2)[1] for x in (at.qd, at.history()))
            closed = torch.zeros(len(qd), len(fit.system.contacts), dtype=torch.bool, device=qd.device)
            states, _ = states_at(fit.system, 0.0 * qd, qd, 0.0 * qd, closed)
            features = fit.posterior.process.features(p, fit.system, replace(states, history=history))
            mean = fit.posterior.latent.latent_mean(p, features)
            forces.append(torch.cat([mean[None], drawn.functions.latent(p, features)]))
            apart.append(-self._from_mean(p, features).flatten()[None])
        return forces, apart

    def _with_laws(self, drawn: list[tuple[RobotModel, Curve]], laws: Laws) -> list[tuple[RobotModel, Curve]]:
        """Return the robots with laws of friction, of joints with memory or with polynomial damping."""
        values = torch.from_numpy(laws.values).to(self.speeds)
        bristle, drag = values[..., 6], values[..., 1:3]
        has_law = (bristle[0] > 0.0) | (drag[0] != 0.0).any(-1)
        if not bool(has_law.any()):
            return drawn
        robots = []
        for (robot, (curve, residual, offset)), law in zip(drawn, values, strict=True):
            d, _, _, f, s, speed, stiffness = law.unbind(-1)
            robot = robot.replace(
                damping=torch.where(has_law, d, robot.damping),
                drag=law[:, 1:3] * has_law[:, None],
                friction=torch.where(has_law, f, robot.friction),
                stribeck=s * has_law,
                stribeck_velocity=torch.where(s * has_law > 0.0, speed, robot.stribeck_velocity),
                bristle=torch.where(stiffness > 0.0, stiffness, per_joint(robot, "bristle")),
            )
            residual = torch.where(has_law, torch.from_numpy(laws.left).to(residual), residual)
            robots.append((robot, (curve, residual, offset)))
        return robots

    def _disagreement(self) -> Tensor:
        """Return b `(1, d)`, the identified inertia minus its posterior mean.

        Instruments identify inertia without bias by noisy accelerations, but from part of the samples; the
        posterior contains all samples, but regards accelerations in the regressor as exact.
        """
        b = [self._kept().flatten()]
        for kind in (InertialPrior, PayloadPrior, DrivePrior):
            for p in [p for p, prior in enumerate(self.fit.force_priors) if isinstance(prior, kind)][:1]:
                one = {name: x[:1] for name, x in self._features(p).items()}
                b.append(-self._from_mean(p, one)[0])
        return torch.cat(b)[None]

    def _consistent(self, values: Tensor, first: int, samples: Tensor) -> Tensor:
        """Return the values `(n, d)` with the most probable physically consistent links and drives.

        Minimises ½ (x − x₀)ᵀ Σ⁻¹ (x − x₀), with the covariance Σ of the samples `(s, d)`, over the entries x
        of J₀^-½ ΔJ J₀^-½ ≥ −1 + ε of each link and over drive inertia of at least zero, by ADMM. The links,
        and the drives after them, start at column `first`; other columns are adjusted according to their
        covariance with these. A link that is unphysical in the file does not change.
        Source: Boyd et al., *Distributed optimization and statistical learning via ADMM* (2011), section 5.
        """
        if self.scale is None:
            return values
        robot, n = self.fit.system.robot, len(MOMENTS)
        w, U = torch.linalg.eigh(pseudo_inertia(robot.mass, robot.com, robot.inertia))
        sound, one = w[:, 0] > 0.0, torch.eye(4).to(w)
        root = (U @ torch.diag_embed(torch.where(sound[:, None], w, 1.0).rsqrt()) @ U.mT)[:, None]
        row, column = torch.triu_indices(4, 4)
        weight = torch.where(row == column, 1.0, 2.0**0.5).to(w)
        entries = root @ (pseudo_inertia_of(torch.eye(n).to(w)) * self.scale[:, :n, None, None]) @ root
        entries = torch.where(sound[:, None, None], entries[..., row, column] * weight, torch.eye(n).to(w))
        drives = self.scale[:, n] if bool(self.scale[:, n].any()) else self.scale[:0, n]
        least = -robot.armature[: len(drives)] / drives.clamp(min=1e-300)
        T, count = torch.block_diag(*entries, torch.eye(len(drives)).to(w)), robot.nq * n
        inertial = slice(first, first + len(T))

        def bodies(x: Tensor) -> Tensor:
            X = x.new_zeros(len(x), robot.nq, 4, 4)
            X[..., row, column] = X[..., column, row] = x[:, :count].view(len(x), robot.nq, n) / weight
            w, V = torch.linalg.eigh(X + one)
            X = V @ torch.diag_embed(w.clamp(min=SMALLEST)) @ V.mT - one
            links = (X[..., row, column] * weight * sound[:, None]).flatten(1)
            return torch.cat([links, torch.maximum(x[:, count:], least)], dim=1)

        x0, spread = values[:, inertial] @ T, samples - samples.mean(0)
        inverse = torch.linalg.inv(T)
        known = torch.linalg.pinv(spread[:, inertial].mT @ spread[:, inertial], hermitian=True)
        precision = (len(spread) - 1) * inverse @ known @ inverse.mT
        # The penalty is scalar for each body, for the projection, and matches the precision of its entries.
        penalty = torch.cat([_scale_of(precision[:count, :count], n), precision.diagonal()[count:]])
        pull = torch.linalg.inv(precision + penalty.diag())
        z, u = bodies(x0), torch.zeros_like(x0)
        for _ in range(ROUNDS):
            x = (x0 @ precision + penalty * (z - u)) @ pull
            x = RELAXATION * x + (1.0 - RELAXATION) * z
            z = bodies(x + u)
            u = u + x - z
        moved = values + (z - x0) @ inverse @ known @ (spread[:, inertial].mT @ spread)
        moved[:, inertial] = z @ inverse
        return moved

    def _offsets(self, curves: Tensor) -> Tensor:
        """Return the offset of each curve `(1 + samples, nq)`, computed by least squares."""
        columns = torch.stack([self.speeds, self.speeds.sign(), torch.ones_like(self.speeds)], dim=-1)
        return (torch.linalg.pinv(columns.movedim(1, 0)) @ curves.movedim(-1, 1)[..., None])[..., 2, 0]

    def _kept(self) -> Tensor:
        """Return the friction at the identified inertia minus the friction at the joint posterior mean."""
        fit, at, force = self.fit, self.at, torch.zeros_like(self.at.q)
        for p, prior in enumerate(fit.force_priors):
            if isinstance(prior, JointTerm):
                latent = self._from_mean(p, self._features(p))
                force = force - torch.einsum("nij,nj->ni", prior.operator(fit.system, at), latent)
        return self._over_poses(force)

    def _from_mean(self, p: int, features: dict[str, Tensor]) -> Tensor:
        """Return the joint posterior mean of latent force p minus its mean given the identified inertia."""
        latent = self.fit.posterior.latent
        apart = latent.latent_mean(p, features, joint=True) - latent.latent_mean(p, features)
        return apart * float(is_identified(self.fit.force_priors))

    def _curves(self, drawn: ForceSamples) -> Tensor:
        """Return the friction Q_D `(1 + samples, k, nq)` of the posterior mean and samples, over poses."""
        fit, at = self.fit, self.at
        priors = [p for p, prior in enumerate(fit.force_priors) if isinstance(prior, JointTerm)]
        known = dynamics.damping_force(fit.system.robot, at.qd)
        curves = self._over_poses(known).expand(drawn.count, -1, -1)
        for p in priors:
            features, E = self._features(p), fit.force_priors[p].operator(fit.system, at)
            for rows in torch.arange(len(E)).split(len(self.speeds)):
                latent = drawn.functions.latent(p, {name: x[rows] for name, x in features.items()})
                curves = curves + torch.einsum("nij,snj->sni", E[rows], latent) / POSES
        mean = self._over_poses(known + fit.posterior.unknown_force(fit.system, at, priors))
        return torch.cat([mean[None], curves])

    def _over_poses(self, force: Tensor) -> Tensor:
        return force.unflatten(0, (POSES, len(self.speeds))).mean(0)

    def _constants(self, drawn: ForceSamples, kind: type) -> Tensor:
        """Return mean and samples of the constants of the first matching prior, `(1 + samples, d)`."""
        for p, prior in enumerate(self.fit.force_priors):
            if isinstance(prior, kind):
                one = {name: x[:1] for name, x in self._features(p).items()}
                mean = self.fit.posterior.latent.latent_mean(p, one)
                return torch.cat([mean, drawn.functions.latent(p, one)[:, 0]])
        return self.speeds.new_zeros(1 + drawn.count, 0)

    def _gain_errors(self, draws: int, generator: torch.Generator) -> Tensor:
        """Return samples of the errors of δ due to those of the gains, `(draws, d)` or zeros `(draws, 1)`."""
        robot = self.fit.system.robot
        prior = next((p for p in self.fit.force_priors if isinstance(p, InertialPrior)), None)
        if prior is None or self.gain_std == 0.0:
            return robot.mass.new_zeros(draws, 1)
        if not prior.per_gain:
            raise ModelError(
                "the effect of the torque sensors' gains on the inertia is unknown",
                expected='inertia identified by a model with inertia="auto"',
                got=f"the prior {prior.name!r}",
            )
        errors = self.gain_std * torch.randn(draws, robot.nq, generator=generator, dtype=robot.dtype)
        shift = robot.mass.new_tensor(prior.per_gain) / prior.scale(robot).clamp(min=1e-300)[:, None]
        return errors.to(robot.device) @ shift.mT

    def _features(self, p: int) -> dict[str, Tensor]:
        return self.fit.posterior.process.features(p, self.fit.system, self.at)

    def _robot(self, curve: Tensor, delta: Tensor, load: Tensor, scale: Tensor) -> tuple[RobotModel, Curve]:
        """Return the robot for a friction curve, deviations δ of inertial parameters, a payload, and errors
        of the scales of torques."""
        robot = self.fit.system.robot
        drives = next((p for p in self.fit.force_priors if isinstance(p, DrivePrior)), None)
        if drives is not None:
            known = torch.ones_like(scale) if robot.torque_scale is None else robot.torque_scale
            robot = robot.replace(torque_scale=known * (1.0 + drives.std * scale))
        damping, friction, residual, offset = _projected(self.speeds, curve)
        robot = robot.replace(damping=damping, friction=friction, stribeck=0.0 * friction, drag=None)
        if self.scale is not None:
            links, drives = delta.split([robot.nq * len(MOMENTS), delta.numel() - robot.nq * len(MOMENTS)])
            robot = _moved(robot, links.view(robot.nq, -1) * self.scale[:, :-1])
            if len(drives):
                armature = (robot.armature + drives * self.scale[:, -1]).clamp(min=0.0)
                robot = robot.replace(armature=armature)
        prior = next((p for p in self.fit.force_priors if isinstance(p, PayloadPrior)), None)
        if prior is not None:
            robot = prior.around(load).loaded(robot)
        return robot, (curve, residual, offset)


def _scale_of(precision: Tensor, n: int) -> Tensor:
    """Return the geometric mean of the eigenvalues of each diagonal block of size n, n times each."""
    blocks = [precision[k : k + n, k : k + n] for k in range(0, len(precision), n)]
    values = torch.linalg.eigvalsh(torch.stack(blocks)).clamp(min=1e-12)
    return values.log().mean(-1).exp().repeat_interleave(n)


def _offset_gain(offset: Tensor, mean: Tensor, values: Tensor) -> Tensor:
    """Return the gain G `(nq, d)` that conditions values z − c G on zero offsets c where undetermined.

    E[z | c = 0] = z − Cov(z, c) Cov(c)⁻¹ c, with the covariances of the samples, which are the rows of
    `offset` and `values` after the first. The posterior mean `(nq,)` of the offsets is compared with zero.
    """
    c = (offset[1:] - offset[1:].mean(0)) * (mean.abs() <= UNDETERMINED_STDS * offset[1:].std(0))
    return torch.linalg.pinv(c.mT @ c, hermitian=True) @ c.mT @ (values[1:] - values[1:].mean(0))


def _projected(speeds: Tensor, curve: Tensor) -> tuple[Tensor, ...]:
    """Return damping d, dry friction f, residual, and offset c of each joint, `(nq,)`."""
    coefficients = []
    for v, force in zip(speeds.T.cpu().numpy(), curve.T.cpu().numpy(), strict=True):
        # −Q_D = d v + f sign v − c
        X = np.stack([v, np.sign(v), -np.ones_like(v)], axis=1)
        fitted = lsq_linear(X, -force, bounds=([0.0, 0.0, -np.inf], np.inf))
        coefficients.append(np.array([*fitted.x[:2], np.sqrt(np.mean(fitted.fun**2)), fitted.x[2]]))
    return torch.from_numpy(np.stack(coefficients, axis=1)).to(curve).unbind()


def _moved(robot: RobotModel, change: Tensor) -> RobotModel:
    """Return the robot with the inertial parameters π + change `(nq, 10)`."""
    J = pseudo_inertia(robot.mass, robot.com, robot.inertia)
    mass, com, inertia = from_pseudo_inertia(J + pseudo_inertia_of(change))
    return robot.replace(mass=mass, com=com, inertia=inertia)


def without_armature(robot: RobotModel, fastest: Tensor) -> RobotModel:
    """Return the robot with its drive inertia added to the links as far as physically possible.

    The relative torque errors of the joints are minimised over n random states:

        min_δ ½ n Σ_j E(Y_j S δ − a_j q̈_j)² / (ε² E τ_j²), with the divergence of `InertialPrior.updated`.

    Args:
        robot: a robot with armature a.
        fastest: largest speeds of these states, reached in a quarter of a second, `(nq,)` [rad/s, m/s].
    """
    held, errors = robot.replace(armature=torch.zeros_like(robot.armature)), InertialPrior()
    generator = torch.Generator().manual_seed(0)
    u = torch.rand(3, STATES, robot.nq, generator=generator, dtype=robot.dtype).to(robot.mass)
    low, high = (x.clamp(-np.pi, np.pi) for x in (robot.lower, robot.upper))
    q, qd, qdd = low + (high - low) * u[0], fastest * (2.0 * u[1] - 1.0), RATE * fastest * (2.0 * u[2] - 1.0)
    size = dynamics.inverse_dynamics(robot, q, qd, qdd).square().mean(0).sqrt() * WANTED
    A = (regressor(held, q, qd, qdd) * (errors.scale(held) / size[:, None])).flatten(0, 1)
    precision = A.mT @ A
    torque = (robot.armature * qdd / size).flatten()
    mean = torch.linalg.pinv(precision, rtol=1e-12, hermitian=True) @ (A.mT @ torque)
    return errors.updated(held, mean, precision)[0]


def _figures(robot: RobotModel, mjcf: bool) -> Tensor:
    """Return the parameters of each joint that a fit can change, `(nq, k)`, in the order of `FIGURES` and, in
    MJCF, `LAW`."""
    friction = torch.stack([robot.damping, robot.friction], dim=-1)
    links = inertial_parameters(robot.mass, robot.com, robot.inertia)
    law = [per_joint(robot, name)[:, None] for name in LAW] if mjcf else []
    return torch.cat([friction, links, robot.armature[:, None], *law], dim=-1)


def _torque_scales(fit: StructuredFit, robot: RobotModel) -> Iterator[Parameter]:
    """Yield the scales of the torques, if they are unknown."""
    scale = robot.torque_scale
    for p in () if scale is None else fit.parameters():
        if scale is not None and SCALE in p.name:
            joint = p.name.split(SCALE)[1]
            value = float(scale[robot.joint_names.index(joint)])
            yield Parameter(joint, "torque_scale", 1.0, value, p.std, p.determined)


def _parameters(
    file: RobotModel, robot: RobotModel, samples: list[RobotModel], scale: Tensor | None, mjcf: bool
) -> tuple[Parameter, ...]:
    """Return all parameters that a fit can change, with their standard deviations over the samples."""
    before, after = _figures(file, mjcf), _figures(robot, mjcf)
    std, prior = torch.stack([_figures(each, mjcf) for each in samples]).std(0), after.abs()
    if scale is not None:
        prior[:, 2 : 2 + scale.shape[-1]] = scale
    determined = (std > 0.0) & (std <= DETERMINED * prior)
    columns = [x.T.flatten().tolist() for x in (before, after, std, determined)]
    names = (*FIGURES, *(LAW if mjcf else ()))
    named = ((joint, name) for name in names for joint in robot.joint_names)
    return tuple(Parameter(*each, *row) for each, *row in zip(named, *columns, strict=True))
