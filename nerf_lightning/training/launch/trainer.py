"""Settings of how and how long to train, and the Lightning Trainer built from them."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import Logger
from lightning.pytorch.plugins.environments import SLURMEnvironment
from lightning.pytorch.strategies import DDPStrategy
from torch import distributed
from torch.nn import Module

from nerf_lightning.compute.devices import LIGHTNING_NAMES, Accelerator
from nerf_lightning.compute.precision import Precision
from nerf_lightning.compute.ranks import processes_here
from nerf_lightning.compute.settings import ComputeSettings, Launcher, cluster_environment
from nerf_lightning.messages.errors import InputError
from nerf_lightning.training.gradients.recorded import not_replayed
from nerf_lightning.training.launch import xla
from nerf_lightning.training.launch.checkpoint_io import AtomicCheckpointIO
from nerf_lightning.training.launch.lightning_flags import passed_through, written_to
from nerf_lightning.training.step import TrainStep


class OneSumPerStep(DDPStrategy):
    """Leave the module unwrapped: the system sums the gradients once per step, after the last tile.

    DDP's wrapper would do so in each tile's backward pass, and requires every parameter to get a gradient there.
    """

    def _setup_model(self, model: Module) -> Module:  # type: ignore[override]
        return model

    def _register_ddp_hooks(self) -> None:
        pass


MOST_EPOCHS = MOST_STEPS = 1 << 31


class TrainerSettings(ComputeSettings):
    """How and how long to train.

    Args:
        max_steps: total number of training steps; None: no limit but max_epochs and budget.seconds.
        published_steps: max_steps of a run that has none of these three on a GPU or TPU, as published with its model.
        max_epochs: number of epochs, each being every training ray once; None: no limit. The smaller limit applies.
        accelerator: the kind of device; auto: a GPU if there is one.
        precision: the precision of products with the fields' weights, and of nothing else. bf16-mixed rounds their
            factors to bfloat16, tf32 to TensorFloat-32 (NVIDIA GPUs); auto is bf16-mixed if the device supports it
            natively and the model is not slower in it, otherwise 32-true.
        tile_points: maximum number of points that a step sends through a field at once; auto: the fastest of a few
            sizes, measured at the start of a run of more than 50 steps; None: the whole batch. The result is the same
            up to rounding.
        clip_norm: maximum norm of the gradient, to which larger ones are scaled down; None: no clipping.
        val_every_steps: steps between validations.
        num_threads: PyTorch's threads on the CPU; None: one per available core.
        compile: compile the levels that have static shapes (torch.compile).
        cuda_graph: record a step's kernels on an NVIDIA GPU and replay them, which saves launch overhead; not
            for refinement and losses that learn. auto: where that is possible, without parts of your own that do not
            say that they decide nothing in Python at each step (replays = True).
        deterministic: refuse nondeterministic GPU operations; the CPU has none.
        devices: processes on this machine, one per device, which share each batch; auto: all GPUs. On a TPU: the cores,
            in one process.
        launched_by: what starts the processes: nerf itself, torchrun, or Slurm's srun; the latter two determine
            `devices`.
        lightning: other arguments of Lightning's Trainer, such as trainer.lightning.profiler=simple; those that another
            setting controls are refused.
    """

    def __init__(
        self,
        max_steps: int | None = None,
        published_steps: int = 200_000,
        max_epochs: int | float | None = None,
        accelerator: Accelerator = "auto",
        precision: Precision = "auto",
        tile_points: int | Literal["auto"] | None = "auto",
        clip_norm: int | float | None = None,
        val_every_steps: int = 500,
        num_threads: int | None = None,
        compile: bool = False,
        cuda_graph: bool | Literal["auto"] = "auto",
        deterministic: bool = False,
        devices: int | Literal["auto"] = 1,
        launched_by: Launcher = "nerf",
        lightning: dict[str, Any] | None = None,
    ):
        for name, value in (
            ("max_steps", max_steps),
            ("published_steps", published_steps),
            ("val_every_steps", val_every_steps),
        ):
            if value is not None and value < 1:
                raise InputError(f"trainer.{name}={value}: give a positive number of steps.")
        if max_epochs is not None and not 0 < max_epochs <= MOST_EPOCHS:
            raise InputError(
                f"trainer.max_epochs={max_epochs}: give a positive number up to {MOST_EPOCHS}, or null for no bound."
            )
        if clip_norm is not None and not 0 < clip_norm < math.inf:
            raise InputError(f"trainer.clip_norm={clip_norm}: give a positive norm, or null for no clipping.")
        super().__init__(accelerator, precision, tile_points, num_threads, devices)
        self.max_steps, self.max_epochs, self.published_steps = max_steps, max_epochs, published_steps
        self.lightning = passed_through(lightning)
        if self.device_type == "xla":
            xla.refuse(compile, launched_by)
        if cuda_graph is True and self.device_type != "cuda":
            raise InputError(
                f"trainer.cuda_graph=true is for NVIDIA GPUs, and this run computes on {self.device_type} "
                f"({self.device_reason}). Leave it out."
            )
        self.cuda_graph = cuda_graph
        self.clip_norm, self.val_every_steps = clip_norm, val_every_steps
        self.compile, self.deterministic = compile, deterministic
        self.launched_by = launched_by  # read before the processes are (launch/processes.py)

    def records(self, train_step: TrainStep) -> bool:
        """Return whether to record a run's steps.

        auto: unless they are compiled, or parts of your own do not say whether they can be replayed.
        """
        if self.cuda_graph != "auto":
            return self.cuda_graph
        tried = self.device_type == "cuda" and not self.compile
        return tried and not not_replayed(train_step.objective, only_known=True)

    def records_there(self, train_step: TrainStep) -> bool:
        """Return whether to record a run's steps on its weights' device: another Trainer may have moved them."""
        return train_step.device.type == self.device_type and self.records(train_step)

    def num_steps(self, num_rays: int, batch_rays: int, crop_steps: int) -> int:
        """Return the length of the run in steps, for a training split of `num_rays` rays; epochs exclude the crop."""
        most = int(self.lightning.get("fast_dev_run", False)) or MOST_STEPS
        most = min(most, self.max_steps or MOST_STEPS)
        if self.max_epochs is None:
            return most
        return min(most, crop_steps - (-int(self.max_epochs * num_rays) // batch_rays))

    def build(self, folder: Path, num_steps: int, callbacks: Sequence[Callback], loggers: Sequence[Logger]) -> Trainer:
        """Return Lightning's Trainer for this process's device, one of several if processes are joined."""
        return Trainer(
            default_root_dir=folder,
            max_steps=num_steps,
            max_epochs=-1,
            **self._placement(),
            deterministic=self.deterministic,
            callbacks=list(callbacks),
            logger=list(loggers) or False,
            val_check_interval=min(self.val_every_steps, num_steps),
            check_val_every_n_epoch=None,
            enable_checkpointing=False,
            enable_progress_bar=any(type(callback).__name__ == "TrainingProgress" for callback in callbacks),
            **written_to(folder, self.lightning),
        )

    def _placement(self) -> dict[str, Any]:
        if self.device_type == "xla":
            return xla.trainer_arguments(int(self.devices))
        several = distributed.is_initialized()
        # Else Lightning would detect Slurm by itself, save in the middle of a step and requeue.
        environment = [cluster_environment()] if several or SLURMEnvironment.detect() else []
        return {
            "accelerator": LIGHTNING_NAMES[self.device_type],
            "devices": processes_here() if several else 1,
            "num_nodes": distributed.get_world_size() // processes_here() if several else 1,
            "strategy": OneSumPerStep() if several else "auto",
            "precision": "32-true",  # Lightning's would lower everything in a step; fields know their own
            "plugins": [AtomicCheckpointIO(), *environment],
        }
