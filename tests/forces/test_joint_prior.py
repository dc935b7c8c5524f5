"""Rows of priors with one force for each joint, whose operator is the identity."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.forces.posterior import ForceProcess
from forcegp.forces.priors.base import ForcePrior, check_priors
from forcegp.forces.priors.contact import NormalForcePrior
from forcegp.forces.priors.joint import AnalyticalMean, JointForcePrior, JointFrictionPrior
from forcegp.forces.priors.memory import BristlePrior
from forcegp.forces.quantities import QUANTITIES, States, affine_map, states
from forcegp.gp.features import Standardization
from forces.cases import draw, mixed_contacts, two_contacts

system = two_contacts()
at = states(system, *draw(12), mixed_contacts(12))


class Geared(JointForcePrior):
    """Forces of motors with a gear."""

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        return 50.0 * super().operator(system, at)


def operators_of(prior: ForcePrior, quantity: str | list[str]) -> Tensor:
    scale = Standardization.none(prior.features(system, at))
    z = affine_map(system, at, quantity)
    return ForceProcess((prior,), (scale,), AnalyticalMean()).rows(system, at, z).operators[0]


@pytest.mark.parametrize("prior", [JointForcePrior(), JointFrictionPrior(), BristlePrior(), Geared()])
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_the_operator_is_that_of_the_quantity_times_that_of_the_prior(
    prior: ForcePrior, quantity: str
) -> None:
    expected = affine_map(system, at, quantity).B_Q @ prior.operator(system, at)
    torch.testing.assert_close(operators_of(prior, quantity), expected, rtol=0.0, atol=0.0)


def test_no_acceleration_shows_a_force_along_the_constraint() -> None:
    prior, H, L = NormalForcePrior(), at.eom.H, at.eom.L
    assert float((H @ prior.operator(system, at)).abs().max()) < 1e-9 * float(H.abs().max())
    shown = operators_of(prior, ["qdd", "multiplier"])
    assert not shown[:, : system.robot.nq].any()
    torch.testing.assert_close(shown[:, system.robot.nq :], -L.mT @ prior.operator(system, at))


def test_an_operator_may_be_inherited_from_elsewhere() -> None:
    class Half:
        def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
            return 0.5 * JointForcePrior().operator(system, at)

    class Mixed(Half, JointForcePrior):
        pass

    for prior in (Mixed(), type("Heir", (Geared,), {})()):
        expected = at.eom.H @ prior.operator(system, at)
        torch.testing.assert_close(operators_of(prior, "qdd"), expected, rtol=0.0, atol=0.0)


def test_a_prior_that_shares_with_a_missing_one_is_refused() -> None:
    with pytest.raises(ModelError, match="shares the hyperparameters of a prior that is missing"):
        check_priors((NormalForcePrior(), JointFrictionPrior()), system)
