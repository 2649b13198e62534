"""Device, precision, threads and tile: everything about the machine that opening and rendering a checkpoint needs."""

from typing import Any, Literal

import torch
from lightning.pytorch.plugins.environments import ClusterEnvironment, SLURMEnvironment, TorchElasticEnvironment
from torch import distributed

from nerf_lightning.compute import ranks, xla_device
from nerf_lightning.compute.cores import MOST_THREADS
from nerf_lightning.compute.devices import Accelerator, choose_device, prepare_machine, working_device
from nerf_lightning.compute.precision import Precision, choose_precision, suited
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.matmul_precision import MatmulPrecision, set_precision
from nerf_lightning.nerf.models.base import Model

CPU_TILE_POINTS = 8_192
GPU_TILE_POINTS = 1 << 20
MOST_CPU_TILE_POINTS = 1 << 18
MOST_GPU_TILE_POINTS = 1 << 22
LEAST_TILE_POINTS = 1 << 10


def default_tile_points(device_type: str) -> int:
    """Return the number of points of a tile that was not measured."""
    return CPU_TILE_POINTS if device_type == "cpu" else GPU_TILE_POINTS


def bounded_tile_points(measured: int, device_type: str) -> int:
    """Return a measured number within bounds: from an untrusted file, it may be tiny (slow) or huge (out of memory)."""
    most = MOST_CPU_TILE_POINTS if device_type == "cpu" else MOST_GPU_TILE_POINTS
    return min(max(measured, LEAST_TILE_POINTS), most)


Launcher = Literal["nerf", "torchrun", "slurm"]
PRODUCTS: dict[str, MatmulPrecision] = {"32-true": "float32", "tf32": "tf32", "bf16-mixed": "bfloat16"}


class ComputeSettings:
    """Where and in which precision to compute. For the arguments see `TrainerSettings`."""

    def __init__(
        self,
        accelerator: Accelerator = "auto",
        precision: Precision = "auto",
        tile_points: int | Literal["auto"] | None = "auto",
        num_threads: int | None = None,
        devices: int | Literal["auto"] = 1,
    ):
        if num_threads is not None and not 1 <= num_threads <= MOST_THREADS:
            raise InputError(f"trainer.num_threads={num_threads}: give a number from 1 to {MOST_THREADS}, or null.")
        if isinstance(tile_points, int) and tile_points < 1:
            raise InputError(f"trainer.tile_points={tile_points}: give a positive number of points, auto or null.")
        self.device_type, self.device_reason = working_device(choose_device(accelerator), accelerator)
        self._chosen = choose_precision(precision, self.device_type)
        self.precision, self.reason = self._chosen
        # XLA would have to compile each size first.
        self.measures_tile = tile_points == "auto" and self.device_type != "xla"
        self.tile_points = default_tile_points(self.device_type) if tile_points == "auto" else tile_points
        self.num_threads, self.devices = num_threads, devices

    def prepare_machine(self) -> None:
        """Configure threads and the allocator, once per process."""
        prepare_machine(self.num_threads)
        if self.device_type == "xla":
            self.devices = xla_device.use_cores(self.devices)

    def take_whole_batches(self) -> None:
        """Turn tiles off, whatever was requested: a part depends on all rays of a step."""
        self.tile_points, self.measures_tile = None, False

    def keep_tile(self, measured: int | None) -> None:
        """Use the tile that a run has measured, unless the user gave one; on a CPU no larger than is ever tried."""
        if self.measures_tile and measured is not None:
            self.tile_points = bounded_tile_points(measured, self.device_type)

    @property
    def device(self) -> torch.device:
        """The device that models go to."""
        if self.device_type == "cuda" and distributed.is_initialized():
            return torch.device("cuda", cluster_environment().local_rank())
        return torch.device(self.device_type)

    @property
    def inference_tile_points(self) -> int:
        """Maximum number of points at once when rendering without gradients."""
        return self.tile_points or default_tile_points(self.device_type)

    def prepare(self, model: Model) -> Model:
        """Move a model to the device, set its fields' precision to the one that suits both, and return it."""
        self.precision, self.reason = suited(*self._chosen, self.device_type, model)
        set_precision(model, PRODUCTS[self.precision])
        return model.to(self.device)

    def describe(self) -> str:
        """Return a description of device and precision, with the reasons for them."""
        count = torch.get_num_threads()
        threads = f", {count} thread{'s' * (count != 1)}" if self.device_type == "cpu" else ""
        processes = f"{ranks.world_size()} processes, each " if ranks.world_size() > 1 else ""
        return f"{processes}{self.device_type}{threads} ({self.device_reason}), {self.precision} ({self.reason})"

    def keep_precision(self, previous: Any) -> None:
        """Keep the precision that a run began with, unless one was requested: it decides the weights' last bits."""
        if self.reason != "as asked":
            self._chosen = self.precision, self.reason = previous, "as when the run started"


def cluster_environment() -> ClusterEnvironment:
    """Return Lightning's view of what started the processes; this program requeues on Slurm itself."""
    if distributed.is_torchelastic_launched():
        return TorchElasticEnvironment()
    return SLURMEnvironment(auto_requeue=False)
