"""Train a radiance field from photographs."""

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from nerf_lightning.commands.train_job.build import build_job
from nerf_lightning.commands.train_job.fit import fit
from nerf_lightning.commands.train_job.held_folder import held_folder
from nerf_lightning.commands.train_job.show import show
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.training.launch.preemption import preemptible
from nerf_lightning.training.launch.processes import on_all_processes


@dataclass(frozen=True)
class Trained:
    """The result of training."""

    folder: Path
    psnr: float | None
    """Of the test views, in dB; of validation if no evaluation follows."""


def run(config: DictConfig) -> float | None:
    """Train and return the test PSNR (that of validation if no evaluation follows), which sweepers may maximize."""
    with preemptible():
        return on_all_processes("train", config, lambda config: train(config).psnr)


def train(config: DictConfig, scene: Scene | None = None) -> Trained:
    """Train as configured, in this process or as one of several: read, build, fit, measure, show.

    Args:
        config: of the run.
        scene: replaces the config's.

    Raises:
        SystemExit: a signal stopped the run (128 + signal), so that a sweep stops too.
    """
    # Bad input is reported here, before a folder is taken.
    job = build_job(config, scene)
    with held_folder(job, config) as folder:
        trainer = fit(job, folder)
        folder.trained(job.clock.seconds)
        psnr = job.post_training(job.settings, job.scene, job.system.model, trainer, folder.path)
        show(job, folder, trainer, psnr)
        folder.note(finished_at_step=trainer.global_step, budget_seconds=job.config.budget.seconds, psnr=psnr)
    return Trained(folder.path, psnr)
