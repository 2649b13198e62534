"""Train from Python like `nerf train`, and access the results."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerf_lightning.cli.prepare import prepared
from nerf_lightning.commands.train import train as train_in_folder
from nerf_lightning.compute.devices import choose_device
from nerf_lightning.config.compose import composed_job
from nerf_lightning.config.error_messages import in_words
from nerf_lightning.config.instantiate import require_fitting_values
from nerf_lightning.files.budgets import Budgets, set_limits
from nerf_lightning.files.json_files import read_json_object
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.notebook.run import of_scene
from nerf_lightning.notebook.trained_model import TrainedModel, load
from nerf_lightning.runs.summary import FILES
from nerf_lightning.training.launch.processes import num_processes


@dataclass(frozen=True)
class TrainedRun:
    """A finished run."""

    folder: Path
    """The run folder: checkpoints, images, TensorBoard files, the film."""
    psnr: float | None
    """Mean PSNR of the test views in dB; of the validation rays if `final.evaluate=false`."""
    metrics: dict[str, Any]
    """The content of metrics.json: the mean of each metric, `per_image`, and the `protocol`; empty if
    `final.evaluate=false`."""
    model: TrainedModel
    """The model of its last checkpoint."""


def train(*overrides: str, scene: Scene | None = None) -> TrainedRun:
    """Train like `nerf train` in this process, and return the run.

    `nl.train("scene=blender", "scene.root=data/lego", "model=fast", "trainer.max_steps=800")` takes the overrides of
    the command line, including `resume=auto` and `paths.output_dir=DIR`. Ctrl-C, or the notebook's stop button, ends
    the run after the current step, with a checkpoint to resume from.

    Args:
        *overrides: settings, one string each.
        scene: from `scene_from_cameras` or `nl.read`, instead of the config's.

    Raises:
        InputError: a setting or the capture is invalid; nothing is left half-written.
        KeyboardInterrupt: the run was stopped; its checkpoint is saved.
    """
    with in_words("train"), composed_job("train", prepared("train", list(of_scene(scene, overrides)))) as config:
        set_limits(Budgets(**config.budgets))
        _require_one_process(config.trainer)
        try:
            done = train_in_folder(config, scene)
        except SystemExit as stop:
            raise KeyboardInterrupt(f"The training was stopped (exit code {stop.code}).") from None
    measured = done.folder / FILES["run"]
    metrics = read_json_object(measured) if config.final.evaluate and measured.is_file() else {}
    of_the_machine = ("trainer=", "trainer.accelerator=", "trainer.num_threads=")
    model = load(done.folder, *(each for each in overrides if each.startswith(of_the_machine)))
    return TrainedRun(done.folder, done.psnr, metrics, model)


def _require_one_process(trainer: Any) -> None:
    require_fitting_values(trainer, "trainer")
    device_type = choose_device(trainer.accelerator)[0]
    if trainer.launched_by != "nerf" or num_processes(trainer.devices, device_type) > 1:
        raise InputError(
            "nl.train trains in this one process, but this trainer needs several. Use nerf train for that, and "
            "nl.load(RUN) afterwards; or trainer.devices=1."
        )
