"""Pictures for the loggers: a validation view at intervals, and the camera layout."""

import time
from pathlib import Path
from typing import Any, Literal

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback
from torch.nn import functional

from nerf_lightning.data.captures.joined import shown_capture
from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.nerf.geometry.world_frame import told_length
from nerf_lightning.nerf.rendering.background import photograph
from nerf_lightning.training.callbacks.watcher import Watcher, render_validation_view
from nerf_lightning.training.loggers import show_picture
from nerf_lightning.visualization.camera_layout import layout_picture
from nerf_lightning.visualization.pictures import mosaic, panels, save_png, to_bytes

USUAL_STEPS = 1000
MOST_OF_TIME = 0.05
"""Share of the training time that pictures may take, unless their number is set."""


class ValidationPictures(Watcher):
    """Render one view of the validation split: truth, render, depth, error; and a frame of the progress video.

    Args:
        every_steps: steps between two images; the first is at step `every_steps`. auto: 1,000, or as many more as keep
            pictures below a twentieth of the time, on devices that take a thousand steps in a second.
        view: which view of the validation split, by its number from 0.
    """

    def __init__(self, every_steps: int | Literal["auto"] = "auto", view: int = 0):
        super().__init__(USUAL_STEPS if every_steps == "auto" else every_steps)
        self.view, self.bounds_time, self.not_before = view, every_steps == "auto", 0.0

    def is_time(self, step: int, last_step: int) -> bool:
        """Return whether to render after a step; always after the last one."""
        waits = self.bounds_time and time.perf_counter() < self.not_before
        return step == last_step or (super().is_time(step, last_step) and not waits)

    def watch(self, trainer: Any, system: Any, outputs: Any) -> None:
        """Render the view, and log its pictures."""
        if not trainer.is_global_zero:
            return
        began, step = time.perf_counter(), trainer.global_step
        view, picture = render_validation_view(trainer, system, self.view)
        scene = trainer.datamodule.scene
        whole = photograph(scene, view, scene.background).movedim(-1, 0)
        truth = functional.interpolate(whole[None], picture.rgb.shape[:2], mode="area")[0].movedim(0, -1)
        # The depth's range is this picture's own: nobody knows yet what the trained field will show.
        panel = mosaic(panels(truth, picture.rgb, told_length(scene)[0] * picture.depth, picture.opacity))
        for name, shown in (("validation", panel), ("progress", to_bytes(picture.rgb))):
            folder = make_folder(Path(trainer.default_root_dir), "images", name)
            save_png(folder / f"step_{step:07d}.png", shown)
        show_picture(trainer.loggers, "validation/picture", panel, step)
        ended = time.perf_counter()
        self.not_before = ended + (ended - began) * (1.0 / MOST_OF_TIME - 1.0)


class CameraLayout(Callback):
    """Draw the camera layout once, after the first step, so that the drawing does not delay the start."""

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Draw if this was the first step of the run."""
        if trainer.global_step == 1 and trainer.loggers:
            scene = shown_capture(trainer.datamodule.scene)  # type: ignore[attr-defined]
            show_picture(trainer.loggers, "scene/cameras", layout_picture(scene), 0)
