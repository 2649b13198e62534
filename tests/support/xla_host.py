"""XLA's CPU device as a stand-in for a TPU, runs on it, and what XLA counts meanwhile."""

import os
from dataclasses import dataclass, field

import torch
from lightning.pytorch import Callback
from lightning.pytorch.accelerators import XLAAccelerator
from support.scenes import ball_scene
from support.static_models import static_system

from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.system import RadianceFieldSystem


class XLAHostAccelerator(XLAAccelerator):
    """Lightning's own looks for TPU chips."""

    is_available = staticmethod(lambda: os.environ.get("PJRT_DEVICE") == "CPU")
    auto_device_count = staticmethod(lambda: 1)
    parse_devices = staticmethod(int)
    get_parallel_devices = staticmethod(lambda count: [torch.device("xla", number) for number in range(count)])
    name = staticmethod(lambda: "xla_cpu")


@dataclass
class Counters(Callback):
    """After each step: its losses, the compilations so far, the numbers read so far, and what ran on the host."""

    losses: list = field(default_factory=list)
    weight: torch.Tensor | None = None
    compilations: list = field(default_factory=list)
    reads: list = field(default_factory=list)
    on_the_host: set = field(default_factory=set)

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.weight = outputs["step"].weight
        self.losses.append(outputs["step"].losses)
        if pl_module.device.type != "xla":
            return
        from torch_xla.debug import metrics

        self.compilations.append(metrics.counter_value("UncachedCompile"))
        self.reads.append(metrics.counter_value("aten::_local_scalar_dense") or 0)
        self.on_the_host |= {name for name in metrics.counter_names() if name.startswith("aten::")}

    def require_quiet_after(self, step: int) -> None:
        """From this step on nothing is compiled any more, and no number is read; nothing ever runs on the host."""
        assert self.on_the_host <= {"aten::_local_scalar_dense"}, f"on the host: {self.on_the_host}"
        assert self.compilations[-1] == self.compilations[step], f"compilations: {self.compilations}"
        assert self.reads[-1] == self.reads[step], f"numbers read: {self.reads}"


@dataclass
class Run:
    """What a short training left."""

    system: RadianceFieldSystem
    counters: Counters
    losses: torch.Tensor


def train(folder, name, accelerator, precision="32-true", steps=30, loss=None, devices=1, callbacks=()) -> Run:
    """Train one of the static models on the ball."""
    scene, progress = ball_scene(num_views=8, size=16, background="random"), Progress()
    settings = TrainerSettings(
        max_steps=steps, accelerator=accelerator, precision=precision, devices=devices, val_every_steps=steps
    )
    settings.prepare_machine()
    system = static_system(name, scene, progress, steps, loss=loss)
    settings.prepare(system.model)
    if accelerator == "tpu":
        from torch_xla.debug import metrics

        metrics.clear_all()
    counters = Counters()
    (folder / "checkpoints").mkdir(parents=True)
    trainer = settings.build(folder, steps, [counters, *callbacks], [])
    trainer.fit(system, RayDataModule(scene, progress, 0, batch_rays=128, val_rays=120))
    return Run(system, counters, torch.stack([loss.cpu() for loss in counters.losses]))
