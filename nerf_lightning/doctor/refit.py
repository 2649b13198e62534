"""Find the pose of one view from what its photograph shares with others, by least squares from several starts."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerf_lightning.doctor.epipolar import rays_of
from nerf_lightning.doctor.matches import Matches

ROUNDS = 20
# Pixels beyond which a match counts less and less, at the first round and at the last.
WIDE, NARROW = 16.0, 1.0


def refitted(
    own: Matches, c2w: Float[Tensor, "views 3 4"], starts: Float[Tensor, "starts 3 4"]
) -> Float[Tensor, "starts 3 4"]:
    """Return each start after Gauss-Newton steps on how far matches lie from the planes of their partners' rays.

    Large distances count less and less (Cauchy's weights, ever narrower), since a part of the matches is mistaken.

    Args:
        own: matches of one view, that view first in each.
        c2w: the poses, of which those of the other views are taken for right.
        starts: poses of the view to begin with.
    """
    rays, _ = rays_of(own, c2w)
    there, focal = rays[:, 1], own.focal[:, 0].double()
    eyes = c2w[own.view[:, 1], :, 3].double()
    local = torch.cat([own.plane[:, 0] * own.plane.new_tensor([1.0, -1.0]), -torch.ones(len(eyes), 1)], dim=-1).double()
    local = functional.normalize(local, dim=-1)
    rotation, center = starts[:, :, :3].double(), starts[:, :, 3].double()
    unit = float((center - eyes.mean(dim=0)).norm(dim=-1).mean().clamp(min=1e-9))

    def off(step: Float[Tensor, "*tried starts 6"]) -> Float[Tensor, "*tried starts matches"]:
        turned = (torch.eye(3) + _cross(step[..., :3])) @ rotation
        between = eyes - (center + unit * step[..., 3:])[..., None, :]
        normal = functional.normalize(torch.linalg.cross(between, there.expand_as(between)), dim=-1)
        return focal * (normal * (local @ turned.mT)).sum(dim=-1)

    tiny = 1e-5
    tried = torch.cat([torch.zeros(1, 6), tiny * torch.eye(6)]).double()[:, None].expand(7, len(starts), 6)
    for number in range(ROUNDS):
        width = WIDE * (NARROW / WIDE) ** (number / (ROUNDS - 1))
        here, *beside = off(tried)
        slopes = (torch.stack(beside, dim=-1) - here[..., None]) / tiny
        weighted = slopes / (1 + (here / width).square())[..., None]
        system = weighted.mT @ slopes
        system = system + (1e-3 * system.diagonal(dim1=1, dim2=2).mean(dim=1) + 1e-9)[:, None, None] * torch.eye(6)
        step = -torch.linalg.solve(system, (weighted.mT @ here[..., None])[..., 0])
        step = step * (0.3 / step.norm(dim=1, keepdim=True).clamp(min=0.3))
        rotation = torch.matrix_exp(_cross(step[:, :3])) @ rotation
        center = center + unit * step[:, 3:]
    return torch.cat([rotation, center[:, :, None]], dim=-1).to(starts)


def _cross(turn: Float[Tensor, "*starts 3"]) -> Float[Tensor, "*starts 3 3"]:
    x, y, z = turn.unbind(dim=-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def with_pose(c2w: Float[Tensor, "views 3 4"], view: int, pose: Float[Tensor, "3 4"]) -> Float[Tensor, "views 3 4"]:
    """Return the poses with one of them changed."""
    changed = c2w.clone()
    changed[view] = pose
    return changed
