"""Pictures for the loggers: a validation view every so often, and where the cameras stand."""

from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback
from torch.nn import functional

from nerf_lightning.data.captures.joined import shown_capture
from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.nerf.geometry.frames import told_length
from nerf_lightning.nerf.rendering.blending import photograph
from nerf_lightning.training.callbacks.watcher import Watcher, render_validation_view
from nerf_lightning.training.loggers import show_picture
from nerf_lightning.visualization.camera_layout import layout_picture
from nerf_lightning.visualization.pictures import mosaic, panels, save_png, to_bytes


class ValidationPictures(Watcher):
    """Render one view of the validation split: truth, render, depth, error; and a frame of the progress video.

    Args:
        every_steps: steps between two images; the first is at step `every_steps`.
        view: which view of the validation split, by its number from 0.
    """

    def __init__(self, every_steps: int = 1000, view: int = 0):
        super().__init__(every_steps)
        self.view = view

    def is_time(self, step: int, last_step: int) -> bool:
        """Tell whether to render after a step; always after the last one."""
        return super().is_time(step, last_step) or step == last_step

    def watch(self, trainer: Any, system: Any, outputs: Any) -> None:
        """Render the view, and save its pictures."""
        if not trainer.is_global_zero:
            return
        step = trainer.global_step
        view, picture = render_validation_view(trainer, system, self.view)
        scene = trainer.datamodule.scene
        whole = photograph(scene, view, scene.background).movedim(-1, 0)
        truth = functional.interpolate(whole[None], picture.rgb.shape[:2], mode="area")[0].movedim(0, -1)
        panel = mosaic(panels(truth, picture.rgb, told_length(scene)[0] * picture.depth, picture.opacity))
        for name, shown in (("validation", panel), ("progress", to_bytes(picture.rgb))):
            folder = make_folder(Path(trainer.default_root_dir), "images", name)
            save_png(folder / f"step_{step:07d}.png", shown)
        show_picture(trainer.loggers, "validation/picture", panel, step)


class CameraLayout(Callback):
    """Draw where the cameras stand once, after the first step, so that the drawing does not delay the start."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Draw, if this was the first step of the run."""
        if trainer.global_step == 1 and trainer.loggers:
            scene = shown_capture(trainer.datamodule.scene)  # type: ignore[attr-defined]
            show_picture(trainer.loggers, "scene/cameras", layout_picture(scene), 0)
