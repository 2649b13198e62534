"""A validation picture every so often: truth, render, depth, error; and the frames of a progress video."""

from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.callbacks.validation_view import render_validation_view
from nerf_lightning.callbacks.writers import tensorboard_writers
from nerf_lightning.errors import require_positive
from nerf_lightning.export.pictures import mosaic, save_png, to_bytes
from nerf_lightning.geometry.frames import unit_of
from nerf_lightning.rendering.blending import photograph


class ValidationPictures(Callback):
    """Render one view of the validation split.

    Args:
        every_steps: steps between two pictures; the first comes at step `every_steps`.
        view: which view of the split.
    """

    def __init__(self, every_steps: int = 1000, view: int = 0):
        require_positive(every_steps=every_steps)
        self.every_steps, self.view = every_steps, view

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Render when it is time."""
        step = trainer.global_step
        if not trainer.is_global_zero or (step % self.every_steps and step != trainer.max_steps):
            return
        view, picture = render_validation_view(trainer, pl_module, self.view)
        scene = trainer.datamodule.scene  # type: ignore[attr-defined]
        truth = photograph(scene, view, scene.background)
        panel = mosaic(truth, picture.rgb, unit_of(scene.to_user) * picture.depth, picture.opacity)
        folder = Path(trainer.default_root_dir) / "images"
        save_png(folder / "validation" / f"step_{step:07d}.png", panel)
        save_png(folder / "progress" / f"step_{step:07d}.png", to_bytes(picture.rgb))
        for writer in tensorboard_writers(trainer.loggers):
            writer.add_image("validation/picture", panel.numpy(), step, dataformats="HWC")
