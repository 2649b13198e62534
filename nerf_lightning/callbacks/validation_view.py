"""One view of the validation split, rendered while training."""

from typing import Any

from nerf_lightning.models.pictures import Picture, render_picture

WHOLE_BATCH_POINTS = 65_536


def render_validation_view(trainer: Any, system: Any, number: int) -> tuple[int, Picture]:
    """Return the number-th validation view (counted round) and its picture, in the precision of training."""
    scene = trainer.datamodule.scene
    views = scene.splits["val"]
    view = views[number % len(views)]
    tile_points = system.tile_points or WHOLE_BATCH_POINTS
    system.eval()
    picture = render_picture(system.model, scene.cameras, view, scene.near, scene.far, scene.background, tile_points)
    system.train()
    return view, picture
