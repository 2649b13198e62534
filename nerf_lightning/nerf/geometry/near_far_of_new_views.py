"""Near and far distances of a scene's content from a camera at any position."""

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.types.scene import SceneRecord

# For a camera within the content, near is this share of the photographs' distance.
LEAST_NEAR = 0.01


def near_and_far_from(
    eyes: Float[Tensor, "frames 3"], scene: SceneRecord
) -> tuple[Float[Tensor, "frames"], Float[Tensor, "frames"]]:
    """Return the near and far distances of a scene's content from cameras at `eyes` (scene units)."""
    if scene.space != "bounded" or scene.cameras.ndc is not None:
        return scene.near.min().expand(len(eyes)), scene.far.max().expand(len(eyes))
    return near_and_far(eyes, scene.cameras.c2w[:, :, 3], scene.aabb.mean(dim=0), scene.near, scene.far)


def near_and_far(
    eyes: Float[Tensor, "frames 3"],
    photographed_from: Float[Tensor, "views 3"],
    middle: Float[Tensor, "3"],
    near: Float[Tensor, "views"],
    far: Float[Tensor, "views"],
) -> tuple[Float[Tensor, "frames"], Float[Tensor, "frames"]]:
    """Return near and far of cameras that need not be where the photographs were taken.

    The photographs determine how far the content of a bounded scene reaches on both sides of its middle, so that it is
    neither cut off from close up nor lost from afar.

    Args:
        eyes: positions of the cameras.
        photographed_from: where the photographs were taken.
        middle: center of the scene's box.
        near: near distance of each photograph.
        far: far distance of each photograph.

    >>> import torch
    >>> middle, photographed_from = torch.zeros(3), torch.tensor([[4.0, 0, 0]])
    >>> eyes = torch.tensor([[0.0, 8, 0], [0, 0, 1]])
    >>> [x.tolist() for x in near_and_far(eyes, photographed_from, middle, torch.tensor([2.0]), torch.tensor([6.0]))]
    [[6.0, 0.03999999910593033], [10.0, 3.0]]
    """
    taken = (photographed_from - middle).norm(dim=-1)
    distance = (eyes - middle).norm(dim=-1)
    before, behind = (taken - near).max(), (far - taken).max()
    return (distance - before).clamp(min=LEAST_NEAR * float(taken.mean())), distance + behind
