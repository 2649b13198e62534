"""A picture of where the cameras stand, for the loggers: a capture's mistakes are seen at a glance."""

from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.data.captures.joined import shown_capture
from nerf_lightning.training.loggers import show_picture
from nerf_lightning.visualization.camera_layout import layout_picture


class CameraLayout(Callback):
    """Draw the cameras once, after the first step, so that the drawing does not delay the start."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Draw, if this was the first step of the run."""
        if trainer.global_step == 1 and trainer.loggers:
            scene = shown_capture(trainer.datamodule.scene)  # type: ignore[attr-defined]
            show_picture(trainer.loggers, "scene/cameras", layout_picture(scene), 0)
