"""Where a self-test is done: the device, its precisions, and the command line at work beside the checks."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.compute.devices import DeviceType, has_tf32
from nerf_lightning.compute.settings import PRODUCTS
from nerf_lightning.config.load_model import load_model
from nerf_lightning.errors import InputError
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.products import Products
from nerf_lightning.selftest.runs import Runs
from nerf_lightning.training.launch.trainer import TrainerSettings

TRAINERS: dict[DeviceType, str] = {"cpu": "cpu", "cuda": "gpu"}


@dataclass(frozen=True)
class Place:
    """What the checks are made for."""

    device: torch.device
    products: tuple[Products, ...]
    """What the device can multiply in; the first is float32."""
    chosen: Products
    """What the user's `trainer` multiplies in."""
    compiles: bool
    """Whether torch.compile is tried: on a GPU, or where the user asks for it."""
    runs: Runs
    """The command line at work on a small capture."""
    read_model: Callable[[Path], Model]
    """Returns the model of a checkpoint, on the CPU."""

    @property
    def is_cuda(self) -> bool:
        """Whether the device is a GPU of CUDA."""
        return self.device.type == "cuda"


def require_known_device(settings: TrainerSettings) -> None:
    """Refuse devices that the checks do not know.

    Raises:
        InputError: it is neither a CPU nor a GPU of CUDA.
    """
    if settings.device_type not in TRAINERS:
        raise InputError(
            f"nerf selftest knows CPUs and NVIDIA GPUs, and trainer.accelerator chose {settings.device_type}. Use "
            "trainer=cpu; for TPUs there is make test-xla."
        )


@contextmanager
def place_for(settings: TrainerSettings) -> Iterator[Place]:
    """Prepare the machine as `trainer` says, and lend the place; what is written there vanishes at the end."""
    settings.prepare_machine()
    overrides = [f"trainer={TRAINERS[settings.device_type]}", f"trainer.precision={settings.precision}"]
    with tempfile.TemporaryDirectory(prefix="nerf-selftest-") as work:
        runs = Runs(Path(work), overrides)
        try:
            yield Place(
                device=settings.device,
                products=_products(settings),
                chosen=PRODUCTS[settings.precision],
                compiles=settings.compile or settings.device_type == "cuda",
                runs=runs,
                read_model=_read_model,
            )
        finally:
            runs.close()


def _products(settings: TrainerSettings) -> tuple[Products, ...]:
    return ("float32", "tf32", "bfloat16") if has_tf32(settings.device_type) else ("float32", "bfloat16")


def _read_model(path: Path) -> Model:
    return load_model(read_checkpoint(path))
