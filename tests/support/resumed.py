"""A checkpoint taken as a resume takes it, up to the first computation, without a process of its own."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from support.running import FAST, output_of, start

from nerf_lightning.commands.train_job.build import assemble_job
from nerf_lightning.config.compose import compose_config
from nerf_lightning.training.launch.checkpoint_io import AtomicCheckpointIO
from nerf_lightning.training.system import RadianceFieldSystem

SHORT = ("final.evaluate=false", "final.video=false", "trainer.precision=32-true")


def trained(folder: Path, capture: Path, *model: str) -> None:
    """Leave a run of 12 steps in folder/run."""
    place = ("scene=npz", f"scene.path={capture}", f"paths.output_dir={folder}/run")
    output_of(start("train", *place, *FAST, *model, *SHORT, "trainer.max_steps=12"))


class Resumed:
    """A run of 25 steps that is to go on from checkpoints of `trained`."""

    def __repr__(self) -> str:
        return str(self.file)

    def __init__(self, run: Path, capture: Path, folder: Path, *model: str):
        settings = ("scene=npz", f"scene.path={capture}", *FAST, *model, *SHORT, "trainer.max_steps=25")
        parts = assemble_job(compose_config("train", settings))
        self.system: RadianceFieldSystem = parts.system
        self.system.trainer = parts.settings.build(folder, 25, parts.callbacks, [])
        self.file = folder / "last.ckpt"
        self.sound: dict[str, Any] = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)

    def take(self, change: Callable[[dict[str, Any]], object]) -> None:
        """Take the sound checkpoint, changed, and update the weights once: compiled optimizers look at no shapes."""
        content = copy.deepcopy(self.sound)
        change(content)
        torch.save(content, self.file)
        self.take_file()

    def take_file(self) -> None:
        """Take what lies in the file."""
        threads = torch.get_num_threads()
        try:
            content = AtomicCheckpointIO().load_checkpoint(self.file)
            self.system.on_load_checkpoint(content)
            self.system.load_state_dict(content["state_dict"])
            optimizer = self.system.configure_optimizers()
            optimizer.load_state_dict(content["optimizer_states"][0])
            for parameter in self.system.model.parameters():
                parameter.grad = torch.ones_like(parameter)
            optimizer.step()
        finally:
            torch.set_num_threads(threads)
