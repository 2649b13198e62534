"""Smooth curves through cameras: positions, rotations and numbers that pass through every key.

A cubic Hermite curve with the tangents of Catmull and Rom for unevenly spaced knots. Rotations are quaternions, whose
curve in four dimensions is normalized.
"""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.nerf.geometry.poses import quaternion_from_rotation, rotation_from_quaternion
from nerf_lightning.nerf.matmul_precision import disable_autocast

SHORTEST_LEG = 1e-2  # The shortest leg as a share of the mean one: coinciding keys are a pause.


def hermite(
    knots: Float[Tensor, "keys"], values: Float[Tensor, "keys channels"], times: Float[Tensor, "frames"]
) -> Float[Tensor, "frames channels"]:
    """Return the curve through `values`, which it passes at `knots` (increasing, two or more), at other times.

    >>> hermite(torch.tensor([0.0, 1, 3]), torch.tensor([[0.0], [1], [3]]), torch.tensor([0.5, 2.0])).flatten().tolist()
    [0.5, 2.0]
    """
    length = knots.diff()[:, None]
    slope = values.diff(dim=0) / length
    inner = (length[:-1] * slope[1:] + length[1:] * slope[:-1]) / (length[:-1] + length[1:])
    tangent = torch.cat([slope[:1], inner, slope[-1:]])
    leg = (torch.searchsorted(knots, times, right=True) - 1).clamp(0, len(knots) - 2)
    h = length[leg]
    s = (times - knots[leg])[:, None] / h
    return (
        (1 + 2 * s) * (1 - s).square() * values[leg]
        + s * (1 - s).square() * h * tangent[leg]
        + s.square() * (3 - 2 * s) * values[leg + 1]
        + s.square() * (s - 1) * h * tangent[leg + 1]
    )


def even_speed(c2w: Float[Tensor, "keys 3 4"], radius: float, closed: bool) -> Float[Tensor, "knots"]:
    """Return the times, 0 to 1, at which to pass poses at about constant speed of moving and turning.

    A leg lasts as long as its distance over `radius` plus its turn in radians. A closed curve has one more knot: that
    at which it is back at the first pose.
    """
    keys = torch.cat([c2w, c2w[:1]]) if closed else c2w
    move = keys[:, :, 3].diff(dim=0).norm(dim=-1) / radius
    cosine = ((keys[1:, :, :3] * keys[:-1, :, :3]).sum(dim=(-2, -1)) - 1) / 2
    legs = move + cosine.clamp(-1, 1).acos()
    legs = legs.clamp(min=SHORTEST_LEG * float(legs.mean())) if float(legs.mean()) > 0 else torch.ones_like(legs)
    return torch.cat([legs.new_zeros(1), legs.cumsum(0)]) / legs.sum()


def frame_times(knots: Float[Tensor, "knots"], num_frames: int, closed: bool) -> Float[Tensor, "frames"]:
    """Return evenly spaced times from the first knot to the last; a closed curve's last frame precedes its first."""
    share = torch.arange(num_frames).to(knots) / max(1, num_frames - (not closed))
    return knots[0] + share * (knots[-1] - knots[0])


def along(
    knots: Float[Tensor, "knots"], values: Float[Tensor, "keys channels"], times: Float[Tensor, "frames"]
) -> Float[Tensor, "frames channels"]:
    """Return the curve at `times`; with one more knot than values it is closed, and smooth where it closes."""
    return hermite(*_continued(knots, values), times)


def _continued(knots: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Return knots and values of the curve; for a closed one, with one more leg at either end."""
    if len(knots) == len(values):
        return knots, values
    period = knots[-1] - knots[0]
    knots = torch.cat([knots[-2:-1] - period, knots, knots[1:2] + period])
    return knots, torch.cat([values[-1:], values, values[:1], values[1:2]])


@disable_autocast
def rotations_along(
    knots: Float[Tensor, "knots"], rotations: Float[Tensor, "keys 3 3"], times: Float[Tensor, "frames"]
) -> Float[Tensor, "frames 3 3"]:
    """Return rotations between those of the keys, each leg the shorter way around."""
    knots, quaternions = _continued(knots, quaternion_from_rotation(rotations))
    # A quaternion and its negative are the same rotation: each takes the sign nearer to the previous one.
    turned = [quaternions[0]]
    for _, following in pairwise(quaternions):
        turned.append(following if turned[-1] @ following >= 0 else -following)
    return rotation_from_quaternion(normalize(hermite(knots, torch.stack(turned), times), dim=-1))


def poses_along(
    knots: Float[Tensor, "knots"], poses: Float[Tensor, "keys 3 4"], times: Float[Tensor, "frames"]
) -> Float[Tensor, "frames 3 4"]:
    """Return poses between those of the keys."""
    places = along(knots, poses[:, :, 3], times)
    return torch.cat([rotations_along(knots, poses[:, :, :3], times), places[:, :, None]], dim=-1)
