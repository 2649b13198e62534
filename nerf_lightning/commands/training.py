"""The training run: build the parts, fit, evaluate, film."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import Logger
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.callbacks.stop_signals import StopSignals
from nerf_lightning.checkpoints import make_record, read_checkpoint
from nerf_lightning.commands.build import build, build_system, load_weights
from nerf_lightning.commands.finish import finish
from nerf_lightning.commands.run_folder import RunFolder, open_run, write_config
from nerf_lightning.commands.tensorboard import describe_run
from nerf_lightning.commands.trainer import TrainerSettings
from nerf_lightning.data.datamodule import RayDataModule
from nerf_lightning.data.ray_batches import Progress
from nerf_lightning.system import RadianceFieldSystem
from nerf_lightning.types import Scene

log = logging.getLogger(__name__)


@dataclass
class Run:
    """A run whose parts are built."""

    config: DictConfig
    folder: RunFolder
    settings: TrainerSettings
    scene: Scene
    data: RayDataModule
    system: RadianceFieldSystem
    trainer: Trainer
    signals: StopSignals


def train(config: DictConfig) -> float | None:
    """Train as the config says; return the PSNR.

    Raises:
        SystemExit: a signal stopped the run (128 + signal), so that a sweep stops too.
    """
    hydra_config = HydraConfig.get()
    settings: TrainerSettings = build(config.trainer)
    settings.prepare_machine()
    scene: Scene = build(config.scene).read()
    num_rays = sum(int(scene.pixels.width[v] * scene.pixels.height[v]) for v in scene.splits["train"])
    num_steps = settings.num_steps(num_rays, config.data.batch_rays)
    in_sweep = hydra_config.mode == RunMode.MULTIRUN
    folder = open_run(config, num_steps, Path(hydra_config.runtime.output_dir) if in_sweep else None)
    try:
        write_config(folder.path, config, hydra_config)
        with _log_file(folder.path):
            run = _assemble(config, folder, settings, scene, num_steps)
            return _fit(run)
    finally:
        folder.release()


def _assemble(config: DictConfig, folder: RunFolder, settings: TrainerSettings, scene: Scene, num_steps: int) -> Run:
    plain = OmegaConf.to_container(config, resolve=True)
    choices = {key: value for key, value in HydraConfig.get().runtime.choices.items() if isinstance(value, str)}
    progress = Progress()
    system = build_system(config, settings, scene, progress, make_record(scene, yaml.safe_dump(plain), choices))
    data = build(config.data)(scene=scene, progress=progress, seed=config.seed, num_steps=num_steps)
    signals = StopSignals()
    callbacks: list[Callback] = [signals, *build(config.callbacks).values()]
    trainer = settings.build(folder.path, num_steps, callbacks, _loggers(config, folder))
    return Run(config, folder, settings, scene, data, system, trainer, signals)


def _fit(run: Run) -> float | None:
    last = run.folder.last_checkpoint
    if last is not None:
        log.info("going on from step %d of %s", read_checkpoint(last).step, run.folder.path)
    elif run.config.init_from is not None:
        load_weights(run.system.model, read_checkpoint(run.config.init_from))
    parameters = sum(p.numel() for p in run.system.model.parameters())
    log.info(
        "run folder %s: %d steps of %d rays, %s parameters, %s, %s",
        run.folder.path,
        run.trainer.max_steps,
        run.data.batches.batch_rays,
        f"{parameters:,}",
        run.settings.describe(),
        "whole batches" if run.settings.tile_points is None else f"tiles of {run.settings.tile_points} points",
    )
    if last is None:
        describe_run(run.trainer.loggers, run.config)
    run.trainer.fit(run.system, run.data, ckpt_path=last, weights_only=True)
    if run.signals.received is not None:
        overrides = " ".join(HydraConfig.get().overrides.task)
        log.info(
            "stopped at step %d; go on with: nerf train %s resume=%s",
            run.trainer.global_step,
            _without_resume(overrides),
            run.folder.path,
        )
        raise SystemExit(128 + run.signals.received)
    metrics = finish(run.config, run.settings, run.scene, run.system.model, run.trainer, run.folder.path)
    run.folder.finish(run.trainer.global_step)
    for logger in run.trainer.loggers:
        logger.finalize("success")
    return metrics


def _loggers(config: DictConfig, folder: RunFolder) -> list[Logger]:
    last = folder.last_checkpoint
    # Steps that were logged after the checkpoint will be logged again: TensorBoard is told to forget them.
    purge: dict[str, Any] = {} if last is None else {"purge_step": read_checkpoint(last).step + 1}
    return [partial(save_dir=folder.path, **purge) for partial in build(config.logger).values()]


def _without_resume(overrides: str) -> str:
    return " ".join(part for part in overrides.split() if not part.startswith(("resume=", "paths.output_dir=")))


@contextmanager
def _log_file(folder: Path) -> Iterator[None]:
    handler = logging.FileHandler(folder / "train.log", encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.getLogger().addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger().removeHandler(handler)
        handler.close()
