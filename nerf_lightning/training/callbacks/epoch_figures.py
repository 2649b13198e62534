"""The article's picture of an epoch: render, depth, and the loss so far."""

from pathlib import Path
from typing import Any, ClassVar

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.messages.errors import require_positive
from nerf_lightning.training.callbacks.watcher import render_validation_view
from nerf_lightning.visualization.figures import epoch_figure, loss_curve
from nerf_lightning.visualization.pictures import save_png


class EpochFigures(Callback):
    """Draw the figure every `every_epochs` epochs, an epoch being every training ray once.

    Args:
        every_epochs: epochs between two figures.
        every_steps: steps between two points of the loss curve.
        view: which view of the validation split is shown.
    """

    STATE: ClassVar = {"steps": list[int], "losses": list[float]}

    def __init__(self, every_epochs: int = 1, every_steps: int = 25, view: int = 0):
        require_positive(every_epochs=every_epochs, every_steps=every_steps)
        self.every_epochs, self.every_steps, self.view = every_epochs, every_steps, view
        self.steps: list[int] = []
        self.losses: list[float] = []

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Collect the loss, and draw when an epoch has ended."""
        if trainer.global_step % self.every_steps == 0:
            self.steps.append(trainer.global_step)
            self.losses.append(float(outputs["step"].losses.cpu().sum()))
        batches = trainer.datamodule.batches  # type: ignore[attr-defined]
        per_figure = self.every_epochs * batches.whole.num_rays
        progress = pl_module.train_step.progress
        seen = progress.rays_seen - batches.crop_rays(progress.restarts)
        if seen > 0 and seen // per_figure > (seen - batches.batch_rays) // per_figure:
            self._draw(trainer, pl_module, epoch=seen // batches.whole.num_rays)

    def on_train_end(self, trainer: Trainer, pl_module: Any) -> None:
        """Draw the whole curve."""
        if trainer.is_global_zero:
            folder = make_folder(Path(trainer.default_root_dir), "images")
            save_png(folder / "loss_curve.png", loss_curve(self.steps, self.losses))

    def state_dict(self) -> dict[str, Any]:
        """Return the curve, for a resume."""
        return {"steps": self.steps, "losses": self.losses}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the curve."""
        self.steps, self.losses = list(state_dict["steps"]), list(state_dict["losses"])

    def _draw(self, trainer: Trainer, system: Any, epoch: int) -> None:
        if not trainer.is_global_zero:
            return
        _, picture = render_validation_view(trainer, system, self.view)
        figure = epoch_figure(picture.rgb, picture.depth, self.steps, self.losses)
        folder = make_folder(Path(trainer.default_root_dir), "images", "epochs")
        save_png(folder / f"epoch_{epoch:04d}.png", figure)
