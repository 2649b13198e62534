"""The contraction of all space into a ball (Sec. 5, arXiv 2111.12077), and the matching spacing of samples.

Kernels repeat both: `kernels/render/dense.py` and `cuda.py`, `kernels/histograms/cpu.py` and `cuda.py`.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.nerf.geometry.boxes import to_unit_cube
from nerf_lightning.nerf.types.scene import Scene


class Contracted(nn.Module):
    """A switch set by the scene, unless the config sets it.

    Args:
        fixed: the config's value; None leaves it to the scene.
    """

    switch: Tensor

    def __init__(self, fixed: bool | None = None):
        super().__init__()
        self.fixed = fixed
        self.register_buffer("switch", torch.tensor(bool(fixed)))
        # Reading the buffer stalls a GPU, so it is read once.
        self._cached: bool | None = bool(fixed)

    def fit_to(self, scene: Scene) -> None:
        """Set the switch as the scene says."""
        if self.fixed is None:
            self.switch.fill_(scene.space == "contracted")
        self.forget()

    def forget(self) -> None:
        """Read the buffer again, since it was written to."""
        self._cached = None

    def is_on(self) -> bool:
        """Return whether space is contracted."""
        if self._cached is None:
            self._cached = bool(self.switch)
        return self._cached

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self.forget()


def in_unit_ball(positions: Float[Tensor, "*points 3"], aabb: Float[Tensor, "2 3"]) -> Float[Tensor, "*points 3"]:
    """Map a box to the cube inscribed in the unit ball: its corners are then on the sphere.

    >>> in_unit_ball(torch.tensor([3.0, 3.0, 3.0]), torch.tensor([[1.0, 1, 1], [3, 3, 3]])).norm().round(decimals=6)
    tensor(1.)
    """
    return (2.0 * to_unit_cube(positions, aabb) - 1.0) / 3**0.5


def contract(positions: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
    """Map all space into the ball of radius 2: x inside the unit ball, `(2 - 1/|x|) x/|x|` outside.

    Eq. 10 of arXiv 2111.12077.

    >>> contract(torch.tensor([[0.5, 0.0, 0.0], [4.0, 0.0, 0.0]]))
    tensor([[0.5000, 0.0000, 0.0000],
            [1.7500, 0.0000, 0.0000]])
    """
    norm = positions.norm(dim=-1, keepdim=True).clamp(min=1.0)
    return positions * (2.0 - 1.0 / norm) / norm


TINY = 1e-6


def normalized_distance(distances: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Map distances to [0, 1]: t / 2 up to 1, then 1 - 1 / (2 t), which is half the norm of `contract` (Eq. 10).

    >>> normalized_distance(torch.tensor([0.0, 0.5, 1.0, 2.0, torch.inf])).tolist()
    [0.0, 0.25, 0.5, 0.75, 1.0]
    """
    return torch.where(distances < 1.0, 0.5 * distances, 1.0 - 0.5 / distances.clamp(min=1.0))


def from_normalized_distance(shares: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Invert `normalized_distance`."""
    return torch.where(shares < 0.5, 2.0 * shares, 0.5 / (1.0 - shares).clamp(min=TINY))
