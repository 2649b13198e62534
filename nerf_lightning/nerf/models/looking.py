"""What a model of many scenes is shown of a scene before it renders it."""

from nerf_lightning.nerf.geometry.photographs import photographs_of
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import Scene


def show_photographs(model: Model, scene: Scene) -> None:
    """Show a model the photographs that it may render a scene from, if it is one that looks at any.

    Raises:
        InputError: they are too few, or of a kind that the model cannot look at.
    """
    if model.needs_photographs:
        model.set_source_images(photographs_of(scene, scene.sources))
