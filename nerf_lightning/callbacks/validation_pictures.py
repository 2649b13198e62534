"""A validation picture every so often: truth, render, depth, error; and the frames of a progress video."""

from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.callbacks.writers import tensorboard_writers
from nerf_lightning.export.pictures import mosaic, save_png, to_bytes
from nerf_lightning.models.pictures import render_picture
from nerf_lightning.rendering.blending import photograph

EVALUATION_TILE_POINTS = 65_536


class ValidationPictures(Callback):
    """Render one view of the validation split.

    Args:
        every_steps: steps between two pictures; the first comes at step `every_steps`.
        view: which view of the split.
    """

    def __init__(self, every_steps: int = 1000, view: int = 0):
        self.every_steps, self.view = every_steps, view

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Render when it is time."""
        step = trainer.global_step
        if step % self.every_steps and step != trainer.max_steps:
            return
        scene = trainer.datamodule.scene  # type: ignore[attr-defined]
        views = scene.splits["val"]
        view = views[self.view % len(views)]
        pl_module.eval()
        tile = pl_module.tile_points or EVALUATION_TILE_POINTS
        with trainer.precision_plugin.forward_context():
            picture = render_picture(
                pl_module.model, scene.cameras, view, scene.near, scene.far, scene.background, tile
            )
        pl_module.train()
        truth = photograph(scene, view, scene.background)
        panel = mosaic(truth, picture.rgb, picture.depth, picture.opacity)
        folder = Path(trainer.default_root_dir) / "images"
        save_png(folder / "validation" / f"step_{step:07d}.png", panel)
        save_png(folder / "progress" / f"step_{step:07d}.png", to_bytes(picture.rgb))
        for writer in tensorboard_writers(trainer.loggers):
            writer.add_image("validation/picture", panel.numpy(), step, dataformats="HWC")
