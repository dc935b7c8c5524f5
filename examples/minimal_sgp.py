"""The structured Gaussian process in one page: equations (10) to (25) on a double pendulum with a wire.

    python examples/minimal_sgp.py

The unknown forces of two joints are learned from the accelerations of 40 states in free motion, and read as
accelerations and as the force of the wire at 40 states on it. Each step uses the library's own parts; the
dense formula of the paper stands beside it, and the two are compared. `forcegp.StructuredGP` does the same
for any robot, contact, prior and log.
"""

# %% The known mechanics: M, Q_C, Q_G from the robot file, A and b from a bead at the tip on a circular wire
import math

import torch

import forcegp
from forcegp.constraints import project_state
from forcegp.forces.quantities import affine_map, states
from forcegp.gp.exact import ExactPosterior
from forcegp.gp.features import Block, Standardization
from forcegp.gp.kernels import SquaredExponential, sub
from forcegp.gp.likelihood import negative_log_likelihood
from forcegp.gp.optimise import LearningOptions, minimise

N, NOISE = 40, 0.1
torch.manual_seed(0)
robot = forcegp.load_robot("double_pendulum")
circle = forcegp.constraints.Cylinder(center=(0.4, 0.0, -0.2), axis=(0.0, 1.0, 0.0), radius=1.2)
bead = forcegp.SurfaceContact("wire", frame="tip", point=(0.0, 0.0, 0.0), surface=circle)
system = forcegp.ConstrainedSystem(robot, [bead])

# %% States in free motion and on the wire, and the unknown force: a friction of the joints
q, qd = project_state(
    system, torch.randn(2 * N, 2).double() * 0.4 + torch.tensor([0.5, -1.0]), torch.randn(2 * N, 2).double()
)
tau = torch.randn(2 * N, 2).double()
closed = (torch.arange(2 * N) >= N)[:, None]
at = states(system, q, qd, tau, closed)
friction = -0.4 * qd - 0.5 * torch.tanh(qd / 0.1)


# %% (14), (15): Q̄ ~ GP(m, k) with m = Q_K + τ, and every quantity is affine in it, z = B Q̄ + o
def prior_of(quantity: str) -> tuple[torch.Tensor, torch.Tensor]:
    """B and the prior mean B m + o: B = H and o = L b for q̈ (4), B = −Lᵀ for λ (16, 19)."""
    z = affine_map(system, at, quantity)
    return z.B_Q, (z.B_Q @ (at.eom.Q_K + tau)[..., None])[..., 0] + z.o


H, prior_qdd = prior_of("qdd")
minus_Lt, prior_multiplier = prior_of("multiplier")
y = prior_qdd + (H @ friction[..., None])[..., 0] + NOISE * torch.randn(2 * N, 2).double()
train, test = slice(0, N), slice(N, 2 * N)


# %% (31), (32): one squared exponential per joint force, seen through H: k_q̈ = H k_Q Hᵀ
class Prior:
    """A process by its kernel and the prefix of its hyperparameters."""

    kernel, prefix = SquaredExponential(("qd",)), "force"


scale = Standardization.of({"qd": qd[train]})
start = {f"force.{k}": v for k, v in Prior.kernel.initial(2, {"qd": 2}).items()}


def rows(own: slice, operator: torch.Tensor, target: torch.Tensor) -> Block:
    """Rows of a quantity in units of the noise."""
    return Block((scale.apply({"qd": qd[own]}),), (operator[own] / NOISE,), target[own] / NOISE)


data = rows(train, H, y - prior_qdd)


# %% (10): the hyperparameters θ_M by maximum likelihood, with the closed-form gradient of the library
def objective(tensors: dict[str, torch.Tensor]) -> torch.Tensor:
    return negative_log_likelihood([Prior], tensors, [data])


learned = minimise(objective, start, LearningOptions(max_evaluations=60)).tensors

# %% (11), (22) to (25): the posterior over the force, from which q̈ and λ are read
posterior = ExactPosterior.of([Prior], learned, [data])
found = {}
for name, B, mean in (("qdd", H, prior_qdd), ("multiplier", minus_Lt, prior_multiplier)):
    # The operator has units of 1/noise in a block: the result is carried back to those of the quantity.
    block = rows(test, B, torch.zeros_like(mean))
    spread = posterior.covariance(block) * NOISE**2
    force = posterior.latent_mean(0, block.features[0])
    found[name] = mean[test] + (B[test] @ force[..., None])[..., 0], spread


# %% The same with the dense formulas of the paper, nq·N rows and one einsum (figure 1)
def covariance(own1: slice, B1: torch.Tensor, own2: slice, B2: torch.Tensor) -> torch.Tensor:
    """Σ = B k B′ᵀ, `(N d, N′ d′)`."""
    x1, x2 = (scale.apply({"qd": qd[own]})["qd"] for own in (own1, own2))
    own = sub(learned, "force")
    apart = (x1[None, :, None] - x2[None, None]) / own["log_lengthscale"].exp()[:, None, None]
    k = own["log_std"].exp()[:, None, None] ** 2 * torch.exp(-0.5 * (apart**2).sum(-1))
    kQ = torch.diag_embed(k.permute(1, 2, 0))
    return torch.einsum("iab,ijbc,jdc->iajd", B1[own1], kQ, B2[own2]).flatten(2).flatten(0, 1)


K = covariance(train, H, train, H) + NOISE**2 * torch.eye(2 * N).double()
residual = (y - prior_qdd)[train].flatten()
likelihood = 0.5 * (residual @ torch.linalg.solve(K, residual) + torch.logdet(2.0 * math.pi * K))
# Rows in units of the noise have a density that is larger by the factor σ per row.
gap = abs(float(likelihood - objective(learned)) - 2 * N * math.log(NOISE))
print(f"(10) negative log likelihood {float(likelihood):.3f}, beside the library's: {gap:.1e}")
assert gap < 1e-6

for name, B, mean in (("qdd", H, prior_qdd), ("multiplier", minus_Lt, prior_multiplier)):
    cross = covariance(test, B, train, H)
    mu = mean[test] + (cross @ torch.linalg.solve(K, residual)).reshape(mean[test].shape)  # (23)
    d = mean.shape[-1]
    spread = covariance(test, B, test, B) - cross @ torch.linalg.solve(K, cross.mT)  # (24)
    own = torch.stack([spread[i * d : (i + 1) * d, i * d : (i + 1) * d] for i in range(N)])
    gap = max(float((mu - found[name][0]).abs().max()), float((own - found[name][1]).abs().max()))
    print(f"(22) to (25) {name}: the library and the dense formula differ by {gap:.1e}")
    assert gap < 1e-6

# %% The result: the constraint holds exactly, and λ is predicted without having been measured
eom, qdd = system.equations(q[test], qd[test]), found["qdd"][0]
truth = prior_multiplier + (minus_Lt @ friction[..., None])[..., 0]
error = (found["multiplier"][0] - truth[test]).abs().mean()
before = (prior_multiplier - truth)[test].abs().mean()
print(f"largest |A qdd − b|: {((eom.A @ qdd[..., None])[..., 0] - eom.b).abs().max():.1e} m/s²")
print(f"mean error of the wire's force: {error:.3f} N; of the prior {before:.3f} N")
