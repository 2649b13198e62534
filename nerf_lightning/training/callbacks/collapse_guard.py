"""The collapse guard: a run that renders a constant picture is noticed early and begun anew."""

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

    With ReLU densities and a white background a run may fall into "all is empty", where no gradient leads out. The sign
    is the spread (standard deviation over rays) of the scene's own light, before the background: below
    `ratio` times the spread of the targets at `patience` looks in a row. The restart draws new weights, a new order
    of rays, and goes through the center crop again; steps already taken are not given back.

    Args:
        every_steps: steps between two looks at the renders.
        until_step: steps after the crop from which on the guard trusts the run.
        patience: looks in a row that must fail.
        ratio: smallest share of the targets' spread that counts as alive.
        max_restarts: how often it restarts at most.

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
        """Look now and then, and log a restart."""
        batches, optimizer = trainer.datamodule.batches, pl_module.optimizers().optimizer  # type: ignore[attr-defined]
        message = self.look(pl_module.train_step, batches, optimizer, outputs["step"], trainer.global_step)
        if message is None:
            return
        for logger in trainer.loggers:
            logger.log_metrics({"train/attempt": pl_module.train_step.progress.attempt}, trainer.global_step)
        for writer in tensorboard_writers(trainer.loggers):
            writer.add_text("collapse_guard", message, trainer.global_step)

    def look(self, train_step: Any, batches: Any, optimizer: Any, output: StepOutput, num_steps: int) -> str | None:
        """Look, where it is time, and restart a run that has collapsed.

        Args:
            train_step: of the run, after a step of it.
            batches: of the run.
            optimizer: of the run.
            output: what the step saw.
            num_steps: taken so far, those of earlier attempts included.

        Returns:
            What was done; None: nothing.
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
        """Remember the looks across a resume."""
        return {"failed": self.failed}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the count up again."""
        self.failed = state_dict["failed"]


def whole_batch(output: StepOutput) -> dict[str, torch.Tensor]:
    """Return what all processes saw of a step's rays."""
    parts = ranks.gather({name: getattr(output, name).cpu() for name in ("foreground", "target", "weight")})
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def is_constant(seen: dict[str, torch.Tensor], ratio: float) -> bool:
    """Return whether the light that the field itself sends is the same for all rays, unlike the photographs.

    Rays of masked pixels do not count: nothing has told the field what lies there.
    """
    seen = {name: value.cpu() for name, value in seen.items()}
    kept = seen["weight"] > 0
    if int(kept.sum()) < 2:
        return False
    target_spread = seen["target"][kept].std(dim=0).amax()
    render_spread = seen["foreground"][kept].std(dim=0).amax()
    return bool((target_spread > 1e-3) & (render_spread < ratio * target_spread))
