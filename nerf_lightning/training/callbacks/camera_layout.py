"""A picture of where the cameras stand, for TensorBoard: a capture's mistakes are seen at a glance."""

from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.training.callbacks.watcher import tensorboard_writers
from nerf_lightning.training.tensorboard import CAMERAS
from nerf_lightning.visualization.camera_layout import layout_picture


class CameraLayout(Callback):
    """Draw the cameras once, after the first step, so that the drawing does not delay the start."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Draw, if this was the first step of the run."""
        if trainer.global_step == 1:
            for writer in tensorboard_writers(trainer.loggers):
                picture = layout_picture(trainer.datamodule.scene)  # type: ignore[attr-defined]
                writer.add_image(CAMERAS, picture.numpy(), 0, dataformats="HWC")
