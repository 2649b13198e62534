"""Which model suits a scene, and how fine its hash grid should be; `auto_settings.py` sets the rest of model=auto."""

import math

import torch

from nerf_lightning.nerf.types.scene import Scene

CONTRACTED_SIDE = 4.0
"""Side of the cube that holds contracted space."""
COARSEST_LEVEL, FINEST_LEVEL = 9, 12
LEAST_DISTANCE = 0.1
"""Of a camera from what it shows, in units of the farthest camera's."""
IN_A_BOX, LARGE, PHOTOGRAPHS = "fast", "fast_large", "fast_proposal"
"""The models of model=auto; LARGE is for large pictures of a scene in a box on a GPU."""
LARGE_CELLS = 1024
"""The finest grid from which pictures are large."""


def model_for(scene: Scene, on_gpu: bool = False) -> tuple[str, str]:
    """Return the model that suits a scene, as model=auto chooses it, and why."""
    if scene.space != "bounded":
        return PHOTOGRAPHS, "the photographs show a background"
    if on_gpu and has_large_pictures(scene):
        return LARGE, "the scene is in a box, the pictures are large, and there is a GPU"
    return IN_A_BOX, "the scene is in a box"


def has_large_pictures(scene: Scene) -> bool:
    """Return whether a scene is in a box, and its pictures are large."""
    return scene.space == "bounded" and grid_for(scene) >= LARGE_CELLS


def grid_for(scene: Scene) -> int:
    """Return the finest resolution of a hash grid whose cells are as small as the pixels.

    Half of the pixels are at least as wide, where they see the scene, as a cell: of the cube from -2 to 2 that all of
    space is contracted to, or of normalized device coordinates, in which a picture has width 2. They see it where
    sparse points or depths say; where there are none, as far away as the middle of the scene.
    """
    cameras, train = scene.cameras, torch.tensor(scene.splits["train"])
    if scene.space == "ndc":
        cells = torch.maximum(cameras.width, cameras.height)[train].double()
    elif scene.depths is not None:
        cells = CONTRACTED_SIDE * cameras.focal.mean(dim=-1)[scene.depths.pixels.view] / scene.depths.distance
    else:
        distance = cameras.c2w[train, :, 3].norm(dim=-1).clamp(min=LEAST_DISTANCE)
        cells = CONTRACTED_SIDE * cameras.focal.mean(dim=-1)[train] / distance
    levels = math.ceil(math.log2(float(cells.median())))
    return 1 << min(max(levels, COARSEST_LEVEL), FINEST_LEVEL)
