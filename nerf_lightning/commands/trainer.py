"""The machine's part of a config: accelerator, precision, tiles, threads; and Lightning's Trainer made from it."""

import ctypes
import logging
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import torch
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import Logger
from lightning.pytorch.plugins.environments import SLURMEnvironment

from nerf_lightning.callbacks.checkpoint_io import AtomicCheckpointIO
from nerf_lightning.cores import num_cores
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

CPU_TILE_POINTS = 8_192
GPU_TILE_POINTS = 1 << 20
MOST_CPU_TILE_POINTS = 1 << 18
ALL_THREADS = min(torch.get_num_threads(), num_cores())
M_MMAP_THRESHOLD = -3
M_TRIM_THRESHOLD = -1


class TrainerSettings:
    """How and for how long to train.

    Args:
        max_steps: steps in all.
        max_epochs: epochs in all, an epoch being every training ray once; None: no bound. The smaller bound counts.
        accelerator: auto takes a GPU where there is one.
        precision: auto is bf16-mixed (float32 weights, bfloat16 products) where the device computes it natively, else
            32-true.
        tile_points: most points that a step sends through a field at once; auto takes the fastest of a few sizes,
            measured at the start of a run and kept; None trains a batch whole. The result is the same up to rounding.
        clip_norm: gradients are scaled down to this norm; None leaves them.
        val_every_steps: steps between two looks at the validation rays.
        num_threads: torch's threads on the CPU; None: one per core that is
            ours (cores.py).
    """

    def __init__(
        self,
        max_steps: int = 200_000,
        max_epochs: int | float | None = None,
        accelerator: Literal["auto", "cpu", "gpu"] = "auto",
        precision: Literal["auto", "32-true", "bf16-mixed"] = "auto",
        tile_points: int | Literal["auto"] | None = "auto",
        clip_norm: int | float | None = None,
        val_every_steps: int = 500,
        num_threads: int | None = None,
    ):
        for name, value in (("max_steps", max_steps), ("val_every_steps", val_every_steps)):
            if value < 1:
                raise InputError(f"trainer.{name}={value}: give a positive number of steps.")
        if max_epochs is not None and max_epochs <= 0:
            raise InputError(f"trainer.max_epochs={max_epochs}: give a positive number, or null for no bound.")
        if isinstance(tile_points, int) and tile_points < 1:
            raise InputError(f"trainer.tile_points={tile_points}: give a positive number of points, auto, or null.")
        if accelerator == "gpu" and not torch.cuda.is_available():
            raise InputError(
                "trainer=gpu: torch sees no CUDA device here. Use trainer=cpu or trainer=auto, or install a CUDA build "
                "of torch and check nvidia-smi."
            )
        self.max_steps, self.max_epochs = max_steps, max_epochs
        self.device_type = "cuda" if accelerator != "cpu" and torch.cuda.is_available() else "cpu"
        self.reason = ""
        self.precision = self._precision(precision)
        default_tile = CPU_TILE_POINTS if self.device_type == "cpu" else GPU_TILE_POINTS
        self.measures_tile = tile_points == "auto"
        self.tile_points = default_tile if tile_points == "auto" else tile_points
        self.clip_norm, self.val_every_steps = clip_norm, val_every_steps
        self.num_threads = num_threads

    def num_steps(self, num_rays: int, batch_rays: int, crop_steps: int) -> int:
        """Return the length of the run in steps, for a training split of `num_rays` rays; the crop is no epoch."""
        if self.max_epochs is None:
            return self.max_steps
        return min(self.max_steps, crop_steps - (-int(self.max_epochs * num_rays) // batch_rays))

    def prepare_machine(self) -> None:
        """Set threads and the allocator, once per process."""
        torch.set_num_threads(self.num_threads or ALL_THREADS)
        _keep_large_blocks()
        _quiet_libraries()

    def build(self, folder: Path, num_steps: int, callbacks: Sequence[Callback], loggers: Sequence[Logger]) -> Trainer:
        """Return Lightning's Trainer for one device."""
        return Trainer(
            default_root_dir=folder,
            max_steps=num_steps,
            max_epochs=-1,
            accelerator="gpu" if self.device_type == "cuda" else "cpu",
            devices=1,
            precision=self.precision,  # type: ignore[arg-type]
            callbacks=list(callbacks),
            logger=list(loggers) or False,
            plugins=[AtomicCheckpointIO(), *_slurm()],
            val_check_interval=min(self.val_every_steps, num_steps),
            check_val_every_n_epoch=None,
            num_sanity_val_steps=0,
            enable_checkpointing=False,
            enable_model_summary=False,
            enable_progress_bar=any(type(callback).__name__ == "TrainingProgress" for callback in callbacks),
            log_every_n_steps=1,
        )

    def keep_tile(self, measured: int | None) -> None:
        """Take the tile that a run has measured, unless the user named one; on a CPU no larger than is ever tried."""
        if self.measures_tile and measured is not None:
            self.tile_points = min(measured, MOST_CPU_TILE_POINTS) if self.device_type == "cpu" else measured

    @property
    def device(self) -> torch.device:
        """The device that models go to."""
        return torch.device(self.device_type)

    @property
    def inference_tile_points(self) -> int:
        """Most points at once when rendering without gradients."""
        return self.tile_points or (CPU_TILE_POINTS if self.device_type == "cpu" else GPU_TILE_POINTS)

    @contextmanager
    def inference(self) -> Iterator[None]:
        """Render in the precision of training, without gradients."""
        with torch.no_grad(), self.autocast():
            yield

    def autocast(self) -> torch.autocast:
        """Multiply in the precision of training, where Lightning does not see to it."""
        return torch.autocast(self.device_type, torch.bfloat16, enabled=self.precision.startswith("bf16"))

    def describe(self) -> str:
        """Say device and precision, with the reason where they were chosen."""
        threads = f", {torch.get_num_threads()} threads" if self.device_type == "cpu" else ""
        return f"{self.device_type}{threads}, {self.precision} ({self.reason})"

    def keep_precision(self, former: str) -> None:
        """Go on in the precision that a run began with, where none is asked for: it decides the weights' last bits."""
        if self.reason != "as asked":
            self.precision, self.reason = former, "as the run began"

    def _precision(self, asked: str) -> str:
        if asked == "auto":
            native = has_native_bfloat16(self.device_type)
            self.reason = f"{'native' if native else 'no native'} bfloat16"
            return "bf16-mixed" if native else "32-true"
        self.reason = "as asked"
        if asked.startswith("bf16") and not has_native_bfloat16(self.device_type):
            log.warning("trainer.precision=%s: this device has no native bfloat16 and emulates it, slowly.", asked)
        return asked


def has_native_bfloat16(device_type: str) -> bool:
    """Tell whether the device multiplies bfloat16 matrices in hardware."""
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    probes = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    return any(getattr(torch.cpu, probe, bool)() for probe in probes)


def _slurm() -> list[SLURMEnvironment]:
    # Lightning would save in the midst of a step and requeue by itself; ours is commands/preemption.py.
    return [SLURMEnvironment(auto_requeue=False)] if SLURMEnvironment.detect() else []


def _keep_large_blocks() -> None:
    # glibc gives blocks of 32 MB and more back to the system at each free; fetching them anew costs more than the
    # arithmetic done in them (measured: 1.5 times the whole step).
    if sys.platform != "linux":
        return
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    mallopt(M_MMAP_THRESHOLD, 1 << 30)
    mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def _quiet_libraries() -> None:
    # Advice about data loader workers and the like, which does not apply: our loader is not a DataLoader.
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    ignored: list[dict[str, Any]] = [
        {"message": ".*does not have many workers.*"},
        {"message": ".*LeafSpec.*", "category": FutureWarning},
        {"message": ".*isinstance.treespec, LeafSpec.*"},
        {"message": ".*ckpt_path.*mid-epoch.*"},
    ]
    for rule in ignored:
        warnings.filterwarnings("ignore", **rule)
