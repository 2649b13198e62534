"""The collapse guard: a run that renders a constant picture is detected early and restarted.

`nerf train` takes its numbers from conf/callbacks/default.yaml.
"""

import logging
from typing import Any, ClassVar

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.compute import ranks
from nerf_lightning.messages.errors import require_positive
from nerf_lightning.nerf.objective import StepOutput
from nerf_lightning.training.attempts import restart
from nerf_lightning.training.callbacks.watcher import tensorboard_writers

log = logging.getLogger(__name__)


class CollapseGuard(Callback):
    """Restart a run whose renders stay constant while the photographs do not.

    With ReLU densities and a white background, a run may fall into the state "all is empty", which has no gradient. The
    criterion is the spread (standard deviation over rays) of the scene's own light, before the background: below
    `ratio` times the spread of the targets at `patience` consecutive checks. The restart draws new weights and a new
    order of rays, and repeats the center crop; steps already taken still count.

    Args:
        every_steps: steps between two checks of the renders.
        until_step: steps after the crop from which the guard trusts the run.
        patience: number of consecutive checks that must fail.
        ratio: minimum share of the targets' spread that counts as alive.
        max_restarts: maximum number of restarts.

    Raises:
        InputError: `every_steps` or `patience` is below 1.
    """

    STATE: ClassVar = {"failed": int}
    needs_state = True

    def __init__(
        self,
        every_steps: int = 25,
        until_step: int = 500,
        patience: int = 6,
        ratio: float = 0.02,
        max_restarts: int = 3,
    ):
        require_positive(every_steps=every_steps, patience=patience)
        self.every_steps, self.until_step, self.patience = every_steps, until_step, patience
        self.ratio, self.max_restarts = ratio, max_restarts
        self.failed = 0

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Check regularly, and log a restart."""
        batches, optimizer = trainer.datamodule.batches, pl_module.optimizers().optimizer  # type: ignore[attr-defined]
        message = self.check(pl_module.train_step, batches, optimizer, outputs["step"], trainer.global_step)
        if message is None:
            return
        for logger in trainer.loggers:
            logger.log_metrics({"train/attempt": pl_module.train_step.progress.attempt}, trainer.global_step)
        for writer in tensorboard_writers(trainer.loggers):
            writer.add_text("collapse_guard", message, trainer.global_step)

    def check(self, train_step: Any, batches: Any, optimizer: Any, output: StepOutput, num_steps: int) -> str | None:
        """Check when it is time, and restart a run that has collapsed.

        Args:
            train_step: the run's training step, after a step.
            batches: the run's batches.
            optimizer: the run's optimizer.
            output: the step's output.
            num_steps: steps taken so far, including those of earlier attempts.

        Returns:
            A description of what was done; None: nothing.
        """
        progress = train_step.progress
        after_crop = (progress.rays_seen - batches.crop_rays(progress.restarts)) / batches.batch_rays
        if progress.step % self.every_steps or after_crop > self.until_step:
            return None
        self.failed = self.failed + 1 if is_constant(whole_batch(output), self.ratio) else 0
        if self.failed < self.patience:
            return None
        self.failed = 0
        if progress.restarts >= self.max_restarts:
            log.warning(
                "Step %d: the renders are constant again, after %d restarts; training goes on as it is. Check the "
                "poses, near and far, or try field.density_activation=softplus, scene.background=random or a smaller "
                "optimizer.lr.",
                num_steps,
                progress.restarts,
            )
            return None
        restart(train_step, optimizer)
        message = (
            f"Step {num_steps}: the renders are constant while the photographs are not (a collapsed run). "
            f"Restarted with new weights: attempt {progress.restarts + 1} of at most {self.max_restarts + 1}."
        )
        log.warning(message)
        return message

    def state_dict(self) -> dict[str, Any]:
        """Return the count of failed checks, for a resume."""
        return {"failed": self.failed}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the count."""
        self.failed = state_dict["failed"]


def whole_batch(output: StepOutput) -> dict[str, torch.Tensor]:
    """Return the rays of a step from all processes."""
    parts = ranks.gather({name: getattr(output, name).cpu() for name in ("foreground", "target", "weight")})
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def is_constant(batch: dict[str, torch.Tensor], ratio: float) -> bool:
    """Return whether the scene's own light is the same for all rays, unlike the photographs.

    Rays of masked pixels do not count: the field has not learned what is there.
    """
    batch = {name: value.cpu() for name, value in batch.items()}
    mask = batch["weight"] > 0
    if int(mask.sum()) < 2:
        return False
    target_spread = batch["target"][mask].std(dim=0).amax()
    render_spread = batch["foreground"][mask].std(dim=0).amax()
    return bool((target_spread > 1e-3) & (render_spread < ratio * target_spread))
