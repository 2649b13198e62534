"""The NaN guard: a run whose numbers are no longer finite is stopped, or rolled back and continued at a lower rate.

`nerf train` takes its numbers from conf/callbacks/default.yaml.
"""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.checkpoints.reading import last_good_checkpoint
from nerf_lightning.compute import ranks
from nerf_lightning.messages.errors import InputError, require_positive
from nerf_lightning.training.attempts import count_rollback, restart
from nerf_lightning.training.callbacks.checkpoints import Checkpoints, writer
from nerf_lightning.training.callbacks.watcher import tensorboard_writers
from nerf_lightning.training.step import TrainStep
from nerf_lightning.training.step_guard import first_not_finite

CURE = (
    "a smaller optimizer.lr, gradient clipping (trainer.clip_norm=1) or trainer.precision=32-true, and check the "
    "capture's poses, near and far"
)

log = logging.getLogger(__name__)


class NanGuard(Callback):
    """Stop or repair a run that no longer learns because its numbers are not finite.

    A step whose gradients are not finite is skipped (`StepGuard`); `patience` of them in a row, or nonfinite weights,
    trigger the guard. A rollback restores weights, optimizer and progress from the last good checkpoint, or starts over
    if there is none, and continues with other random numbers at a lower learning rate: a new attempt. Steps already
    taken still count. Rate and attempt are part of subsequent checkpoints.

    Args:
        on_nan: stop ends the run; rollback returns to the last good checkpoint and continues at a lower learning rate.
        patience: the number of consecutive bad steps that triggers it.
        factor: the factor by which a rollback multiplies the learning rate.
        max_rollbacks: the maximum number of rollbacks before it stops.
        every_steps: steps between checks of the weights, and of the count of bad steps on devices that reading it would
            stall (elsewhere it is read in each step).
    """

    def __init__(
        self,
        on_nan: Literal["stop", "rollback"] = "stop",
        patience: int = 10,
        factor: float = 0.5,
        max_rollbacks: int = 3,
        every_steps: int = 100,
    ):
        require_positive(patience=patience, every_steps=every_steps)
        if not 0 < factor < 1:
            raise InputError(f"callbacks.nan_guard.factor={factor}: give a factor on the rate between 0 and 1.")
        self.on_nan, self.patience, self.every_steps = on_nan, patience, every_steps
        self.factor, self.max_rollbacks = factor, max_rollbacks

    def setup(self, trainer: Trainer, pl_module: Any, stage: str) -> None:
        """Check that there will be checkpoints to return to, or to name.

        Raises:
            InputError: the checkpoints are written by something else.
        """
        writer(trainer, self)

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Check whether the run still learns.

        Raises:
            InputError: it does not, and rollbacks are off or exhausted.
        """
        if cause := self.cause(pl_module.train_step):
            self._act(trainer, pl_module, cause)

    def cause(self, train_step: TrainStep) -> str | None:
        """Return why a run no longer learns, after a step; None: it does, or it was not time to check."""
        guard, number = train_step.guard, train_step.progress.step
        looks = number % self.every_steps == 0
        if (looks or train_step.device.type == "cpu") and guard.in_row >= self.patience:
            return (
                f"The loss or its gradients are not finite numbers since step {number - guard.in_row + 1} "
                f"({guard.in_row} steps in a row, all left out; first in the gradient of {guard.first_module})"
            )
        if looks and (broken := first_not_finite(train_step.objective.named_weights())):
            return f"The weights of step {number} are not finite numbers (first those of {broken})"
        return None

    def _act(self, trainer: Trainer, system: Any, cause: str) -> None:
        good, progress = ranks.from_first(lambda: self._last_good(trainer)), system.train_step.progress
        if self.on_nan == "stop" or progress.rollbacks >= self.max_rollbacks:
            raise InputError(f"{cause}, so the run stops. {self._advice(trainer, good)}")
        self._roll_back(trainer, system, good)
        place = f"checkpoint {good}" if good is not None else "beginning, with new weights, as no checkpoint was saved"
        rate = system.optimizers().param_groups[0]["base_lr"]
        message = (
            f"{cause}. Rolled back to the {place}: attempt {progress.attempt + 1}, rollback "
            f"{progress.rollbacks} of at most {self.max_rollbacks}, base learning rate {rate:.3g}."
        )
        log.warning(message)
        for logger in trainer.loggers:
            logger.log_metrics({"train/attempt": progress.attempt}, trainer.global_step)
        for board in tensorboard_writers(trainer.loggers):
            board.add_text("nan_guard", message, trainer.global_step)

    def _roll_back(self, trainer: Trainer, system: Any, good: Path | None) -> None:
        train_step = system.train_step
        former, skipped = replace(train_step.progress), train_step.guard.skipped
        lowered = former.rollbacks
        if good is None:
            restart(train_step, system.optimizers().optimizer)
        else:
            content = trainer.strategy.load_checkpoint(good, weights_only=True)
            system.on_load_checkpoint(content)
            trainer.strategy.load_model_state_dict(content)
            trainer.strategy.load_optimizer_state_dict(content)
            lowered = content["nerf_lightning"]["progress"]["rollbacks"]
        count_rollback(train_step, former, skipped)
        for group in system.optimizers().param_groups:
            # The rate in the checkpoint may be from before an earlier rollback.
            group["base_lr"] = group.get("base_lr", group["lr"]) * self.factor ** (former.rollbacks + 1 - lowered)

    def _advice(self, trainer: Trainer, good: Path | None) -> str:
        if good is None:
            return f"No checkpoint was saved yet: begin anew with {CURE}."
        resume = f"resume={trainer.default_root_dir} callbacks.nan_guard.on_nan=rollback"
        lower = f"Go on from it at a lower rate with {resume}, or begin" if self.on_nan == "stop" else "Begin"
        weights = f"a new run from its weights (init_from={good})"
        return f"The last good checkpoint is {good}. {lower} {weights} with {CURE}."

    def _last_good(self, trainer: Trainer) -> Path | None:
        writer(trainer, self).wait()
        return last_good_checkpoint(Checkpoints.folder(trainer))
