"""Camera poses: checks and constructions. Poses are camera-to-world with columns right, up, back, center."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.nerf.matmul_precision import disable_autocast


@disable_autocast
def is_rigid(c2w: Float[Tensor, "*views 3 4"], tolerance: float = 1e-3) -> Bool[Tensor, "*views"]:
    """Return which poses have a valid rotation (orthonormal, determinant +1) and a finite center."""
    rotation = c2w[..., :3]
    identity = torch.eye(3, dtype=c2w.dtype, device=c2w.device)
    off = (rotation.mT @ rotation - identity).abs().amax(dim=(-2, -1))
    finite = torch.isfinite(c2w).all(dim=-1).all(dim=-1)
    return finite & (off < tolerance) & (torch.linalg.det(torch.nan_to_num(rotation)) > 0)


def flip_yz(c2w: Float[Tensor, "*views 3 4"]) -> Float[Tensor, "*views 3 4"]:
    """Convert camera-to-world poses from OpenCV's axes (right, down, ahead) to ours (right, up, back), or back."""
    return c2w * c2w.new_tensor([1.0, -1.0, -1.0, 1.0])


def rotation_from_quaternion(quaternion: Float[Tensor, "*views 4"]) -> Float[Tensor, "*views 3 3"]:
    """Return the rotation of a quaternion w, x, y, z of any nonzero length.

    >>> rotation_from_quaternion(torch.tensor([1.0, 0.0, 0.0, 1.0])).round().tolist()  # a quarter turn around z
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    w, x, y, z = (quaternion / quaternion.norm(dim=-1, keepdim=True)).unbind(dim=-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


SMALL_ANGLE = 0.1
"""Below it (radians) the coefficients of the exponential map use their series, accurate to 1e-14."""


@disable_autocast
def rotation_from_vector(vector: Float[Tensor, "*views 3"]) -> Float[Tensor, "*views 3 3"]:
    """Return the rotation about an axis by its length in radians: the exponential map of SO(3).

    exp(K) = I + (sin a / a) K + ((1 - cos a) / a^2) K^2 (Rodrigues), where a is the length and K x = vector cross x.
    Near zero both coefficients are their Taylor series in a^2, so that gradients are finite at zero, too.

    >>> quarter_turn = rotation_from_vector(torch.tensor([0.0, 0.0, torch.pi / 2]))  # around z
    >>> (quarter_turn @ torch.tensor([1.0, 2.0, 3.0])).round().tolist()
    [-2.0, 1.0, 3.0]
    """
    square = vector.square().sum(dim=-1)
    is_small = square < SMALL_ANGLE**2
    # The branch not taken gets a safe angle: its gradient would be NaN, and NaN times 0 is NaN.
    angle = torch.where(is_small, 1.0, square).sqrt()
    series = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0)))
    half_series = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0 * (1.0 - square / 90.0)))
    first = torch.where(is_small, series, angle.sin() / angle)
    second = torch.where(is_small, half_series, 2.0 * ((0.5 * angle).sin() / angle).square())
    x, y, z = vector.unbind(dim=-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    identity = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return identity + first[..., None, None] * skew + second[..., None, None] * (skew @ skew)


def quaternion_from_rotation(rotation: Float[Tensor, "*views 3 3"]) -> Float[Tensor, "*views 4"]:
    """Return the unit quaternion w, x, y, z (w not negative) of a rotation; the inverse of `rotation_from_quaternion`.

    It is the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix (AIAA 00-4101, 2000), so no case is special.

    >>> quaternion_from_rotation(torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])).abs()  # a quarter turn around z
    tensor([0.7071, 0.0000, 0.0000, 0.7071])
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(dim=-1) for row in rotation.double().unbind(dim=-2))
    rows = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    matrix = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    vector = torch.linalg.eigh(matrix)[1][..., -1]
    return torch.where(vector[..., :1] < 0, -vector, vector).to(rotation)


def look_at(
    eye: Float[Tensor, "*views 3"], target: Float[Tensor, "*views 3"], up: Float[Tensor, "3"]
) -> Float[Tensor, "*views 3 4"]:
    """Return cameras at `eye` that look at `target`, with the picture's top toward `up`.

    >>> eye, target, up = torch.tensor([0.0, -4, 0]), torch.zeros(3), torch.tensor([0.0, 0, 1])
    >>> look_at(eye, target, up)[:, 2].tolist()  # the back axis points from the target to the eye
    [0.0, -1.0, 0.0]
    """
    back = torch.nn.functional.normalize(eye - target, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(up.expand_as(back), back), dim=-1)
    return torch.stack([right, torch.linalg.cross(back, right), back, eye], dim=-1)
