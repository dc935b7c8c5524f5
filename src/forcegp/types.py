"""Shape aliases for tensors; the batch dimensions come first, `(*batch, …)`.

The batch dimensions of joint vectors are broadcast against each other (`*#batch`). The sizes are `nq` joints,
`nf` frames, `m` constraint rows, `n` samples and `d` components. The aliases document shapes in signatures,
and the test suite enforces them at run time.
"""

from __future__ import annotations

from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

Array = Any
"""A NumPy array; its shape is given in the docstring."""
Scalars = Float[Tensor, "*batch"]
Vector3 = Float[Tensor, "*batch 3"]
Rotation = Float[Tensor, "*batch 3 3"]
JointVector = Float[Tensor, "*#batch nq"]
JointMatrix = Float[Tensor, "*batch nq nq"]
PointJacobian = Float[Tensor, "*batch 3 nq"]
FrameJacobian = Float[Tensor, "*batch 6 nq"]
ConstraintVector = Float[Tensor, "*batch m"]
ConstraintMatrix = Float[Tensor, "*batch m nq"]
ConstraintInverse = Float[Tensor, "*batch nq m"]
ActiveContacts = Bool[Tensor, "*batch m"]
