"""The machine's part of a config: devices, precision, tiles, threads; and Lightning's Trainer made from it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import Logger
from lightning.pytorch.plugins.environments import SLURMEnvironment
from torch import distributed

from nerf_lightning import ranks
from nerf_lightning.checkpoints.format import MOST_THREADS
from nerf_lightning.errors import InputError
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.products import Products
from nerf_lightning.ranks import processes_here
from nerf_lightning.training.launch import xla
from nerf_lightning.training.launch.checkpoint_io import AtomicCheckpointIO
from nerf_lightning.training.launch.devices import (
    LIGHTNING_NAMES,
    Accelerator,
    Precision,
    choose_device,
    choose_precision,
    prepare_machine,
    suited,
    working_device,
)
from nerf_lightning.training.launch.lightning_flags import passed_through, written_to
from nerf_lightning.training.launch.strategy import Launcher, OneSumPerStep, cluster_environment

PRODUCTS: dict[str, Products] = {"32-true": "float32", "tf32": "tf32", "bf16-mixed": "bfloat16"}
MOST_EPOCHS = 1 << 31
MOST_PROCESSES = 1024
"""Of one machine; each takes half a gigabyte and more."""
CPU_TILE_POINTS = 8_192
GPU_TILE_POINTS = 1 << 20
MOST_CPU_TILE_POINTS = 1 << 18
MOST_GPU_TILE_POINTS = 1 << 22
LEAST_TILE_POINTS = 1 << 10


class TrainerSettings:
    """How and for how long to train.

    Args:
        max_steps: steps of the training in all.
        max_epochs: epochs in all, an epoch being every training ray once; None: no bound. The smaller bound counts.
        accelerator: the kind of device; auto takes a GPU where there is one.
        precision: of the products of the fields' weights, and of nothing else. bf16-mixed rounds their factors to
            bfloat16, tf32 to TensorFloat-32 (NVIDIA GPUs); auto is bf16-mixed where the device computes it natively
            and the model is not slower in it, else 32-true.
        tile_points: most points that a step sends through a field at once; auto takes the fastest of a few sizes,
            measured at the start of a run (but for one of 50 steps or fewer) and kept; None trains a batch whole. The
            result is the same up to rounding.
        clip_norm: gradients are scaled down to this norm; None leaves them.
        val_every_steps: steps between two looks at the validation rays.
        num_threads: torch's threads on the CPU; None: one per core of ours.
        compile: compile the levels that have static shapes (torch.compile).
        cuda_graph: record a step's kernels on an NVIDIA GPU and replay them, which saves the time of asking for each;
            for models with an occupancy grid. Not yet run on a GPU.
        deterministic: refuse operations of GPUs whose sums depend on chance; the CPU's never do.
        devices: processes on this machine, one per device; auto: every GPU. They divide each batch among them. On a
            TPU the cores, of one process.
        launched_by: who starts the processes: nerf itself, torchrun, or Slurm's srun; then `devices` is theirs to say.
        lightning: other arguments of Lightning's Trainer, such as trainer.lightning.profiler=simple; those that a
            setting of ours says are refused.
    """

    def __init__(
        self,
        max_steps: int = 200_000,
        max_epochs: int | float | None = None,
        accelerator: Accelerator = "auto",
        precision: Precision = "auto",
        tile_points: int | Literal["auto"] | None = "auto",
        clip_norm: int | float | None = None,
        val_every_steps: int = 500,
        num_threads: int | None = None,
        compile: bool = False,
        cuda_graph: bool = False,
        deterministic: bool = False,
        devices: int | Literal["auto"] = 1,
        launched_by: Launcher = "nerf",
        lightning: dict[str, Any] | None = None,
    ):
        for name, value in (("max_steps", max_steps), ("val_every_steps", val_every_steps)):
            if value < 1:
                raise InputError(f"trainer.{name}={value}: give a positive number of steps.")
        if max_epochs is not None and not 0 < max_epochs <= MOST_EPOCHS:
            raise InputError(
                f"trainer.max_epochs={max_epochs}: give a positive number up to {MOST_EPOCHS}, or null for no bound."
            )
        if num_threads is not None and not 1 <= num_threads <= MOST_THREADS:
            raise InputError(f"trainer.num_threads={num_threads}: give a number from 1 to {MOST_THREADS}, or null.")
        if isinstance(tile_points, int) and tile_points < 1:
            raise InputError(f"trainer.tile_points={tile_points}: give a positive number of points, auto, or null.")
        self.max_steps, self.max_epochs = max_steps, max_epochs
        self.lightning = passed_through(lightning)
        self.device_type, self.device_reason = working_device(choose_device(accelerator), accelerator)
        if self.device_type == "xla":
            xla.refuse(compile, launched_by)
        if cuda_graph and self.device_type != "cuda":
            raise InputError(
                f"trainer.cuda_graph=true is for NVIDIA GPUs, and this run computes on {self.device_type} "
                f"({self.device_reason}). Leave it out."
            )
        self.cuda_graph = cuda_graph
        self._chosen = choose_precision(precision, self.device_type)
        self.precision, self.reason = self._chosen
        default_tile = CPU_TILE_POINTS if self.device_type == "cpu" else GPU_TILE_POINTS
        # On XLA each size would be compiled first.
        self.measures_tile = tile_points == "auto" and self.device_type != "xla"
        self.tile_points = default_tile if tile_points == "auto" else tile_points
        self.clip_norm, self.val_every_steps = clip_norm, val_every_steps
        self.num_threads = num_threads
        self.compile, self.deterministic = compile, deterministic
        self.devices, self.launched_by = devices, launched_by  # read before the processes are (commands/processes.py)

    def num_steps(self, num_rays: int, batch_rays: int, crop_steps: int) -> int:
        """Return the length of the run in steps, for a training split of `num_rays` rays; the crop is no epoch."""
        most = min(self.max_steps, int(self.lightning.get("fast_dev_run", False)) or self.max_steps)
        if self.max_epochs is None:
            return most
        return min(most, crop_steps - (-int(self.max_epochs * num_rays) // batch_rays))

    def prepare_machine(self) -> None:
        """Set threads and the allocator, once per process."""
        prepare_machine(self.num_threads)
        if self.device_type == "xla":
            self.devices = xla.use_cores(self.devices)

    def build(self, folder: Path, num_steps: int, callbacks: Sequence[Callback], loggers: Sequence[Logger]) -> Trainer:
        """Return Lightning's Trainer for this process's device, one of several where processes are joined."""
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
        # Else Lightning would find Slurm by itself, save in the midst of a step and requeue.
        environment = [cluster_environment()] if several or SLURMEnvironment.detect() else []
        return {
            "accelerator": LIGHTNING_NAMES[self.device_type],
            "devices": processes_here() if several else 1,
            "num_nodes": distributed.get_world_size() // processes_here() if several else 1,
            "strategy": OneSumPerStep() if several else "auto",
            "precision": "32-true",  # Lightning's would lower whatever stands in a step; fields know their own
            "plugins": [AtomicCheckpointIO(), *environment],
        }

    def keep_tile(self, measured: int | None) -> None:
        """Take the tile that a run has measured, unless the user named one; on a CPU no larger than is ever tried."""
        if self.measures_tile and measured is not None:
            # The number comes out of a file: ever smaller tiles take hours, ever larger ones the memory.
            most = MOST_CPU_TILE_POINTS if self.device_type == "cpu" else MOST_GPU_TILE_POINTS
            self.tile_points = min(max(measured, LEAST_TILE_POINTS), most)

    @property
    def device(self) -> torch.device:
        """The device that models go to."""
        if self.device_type == "cuda" and distributed.is_initialized():
            return torch.device("cuda", cluster_environment().local_rank())
        return torch.device(self.device_type)

    @property
    def inference_tile_points(self) -> int:
        """Most points at once when rendering without gradients."""
        return self.tile_points or (CPU_TILE_POINTS if self.device_type == "cpu" else GPU_TILE_POINTS)

    def prepare(self, model: Model) -> Model:
        """Put a model on the device, let its fields multiply in the precision that suits both, and return it."""
        self.precision, self.reason = suited(*self._chosen, self.device_type, model)
        model.multiply_in(PRODUCTS[self.precision])
        return model.to(self.device)

    def describe(self) -> str:
        """Say device and precision, with the reason where they were chosen."""
        threads = f", {torch.get_num_threads()} threads" if self.device_type == "cpu" else ""
        processes = f"{ranks.world_size()} processes, each " if ranks.world_size() > 1 else ""
        return f"{processes}{self.device_type}{threads} ({self.device_reason}), {self.precision} ({self.reason})"

    def keep_precision(self, former: Any) -> None:
        """Go on in the precision that a run began with, where none is asked for: it decides the weights' last bits."""
        if self.reason != "as asked":
            self._chosen = self.precision, self.reason = former, "as the run began"
