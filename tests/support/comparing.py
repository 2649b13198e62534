"""How far apart tensors are."""

from torch import Tensor


def far_apart(found: Tensor, expected: Tensor) -> float:
    """Return the norm of the difference, relative to that of what is expected."""
    return float((found.double() - expected).norm() / expected.norm().clamp(min=1e-30))
