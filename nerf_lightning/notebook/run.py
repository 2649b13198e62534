"""Build a run from Python, for Lightning's own Trainer, or for training step by step without one."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lightning import __version__ as lightning_version
from torch.optim import Optimizer

from nerf_lightning.checkpoints.format import KEY, LIGHTNING
from nerf_lightning.checkpoints.reading import checkpoint_of, content_to_resume, read_checkpoint
from nerf_lightning.checkpoints.same_capture import require_same_capture
from nerf_lightning.checkpoints.writing import write_checkpoint
from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.overrides import key_of, quoted
from nerf_lightning.files.budgets import Budgets, set_limits
from nerf_lightning.files.yaml_files import plain_yaml
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.psnr import psnr
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.notebook.trained_model import TrainedModel
from nerf_lightning.runs.plan_run import Run, plan_run
from nerf_lightning.training.callbacks.collapse_guard import CollapseGuard
from nerf_lightning.training.callbacks.nan_guard import CURE, NanGuard
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.training.restore import loops_after, require_resumable, restore_run
from nerf_lightning.training.step_guard import first_not_finite

OF_LIGHTNINGS_TRAINER = {
    "trainer.max_steps": "Trainer(max_steps=...), or run.steps(...)",
    "trainer.max_epochs": "Trainer(max_epochs=...)",
    "trainer.val_every_steps": "Trainer(val_check_interval=...)",
    "trainer.lightning": "Trainer(...)",
    "callbacks": "Trainer(callbacks=[...])",
    "viewer": "Trainer(callbacks=[LiveView(...)])",
    "budget": "Trainer(callbacks=[TimeBudget(...)])",
    "logger": "Trainer(logger=...)",
    "paths": "Trainer(default_root_dir=...)",
    "resume": "Trainer.fit(..., ckpt_path=...), or build_run(..., resume=...)",
}
"""Settings of `nerf train` that are specified elsewhere here."""


@dataclass
class StepwiseRun(Run):
    """A run that Lightning's Trainer fits (`Trainer.fit(run.system, run.data)`), or that is trained by `steps`."""

    collapse_guard: CollapseGuard
    nan_guard: NanGuard
    num_steps: int = 0
    """Number of steps taken by `steps`, including those before a restart and before `resume`."""
    _optimizer: Optimizer | None = None

    def steps(self, until: int) -> Iterator[dict[str, float]]:
        """Train until `until` steps have been taken in total, which is the length that the learning rate follows.

        Between two steps the run can be saved, rendered and left; `steps` continues where it stopped.

        Args:
            until: the step after which the run ends, like `Trainer(max_steps=...)`.

        Yields:
            After each step, its number (`step`), `loss`, `psnr` (dB, of its rays) and `num_rays`.

        Raises:
            InputError: the run no longer learns (NanGuard), or Lightning's Trainer has trained it.
        """
        train_step, batches, optimizer = self.system.train_step, self.data.batches, self.optimizer
        train_step.num_steps = until
        self.data.settle(train_step.device)
        train_step.begin_recording()
        rays = iter(batches)
        while self.num_steps < until:
            self.system.train()
            batch = next(rays).to(train_step.device)
            seen = train_step(batch, optimizer)
            self.num_steps += 1
            self.collapse_guard.check(train_step, batches, optimizer, seen, self.num_steps)
            if cause := self.nan_guard.cause(train_step):
                raise InputError(f"{cause}, so the run stops. Start again, or resume a checkpoint, with {CURE}.")
            measured = {"loss": float(seen.losses.sum()), "psnr": float(psnr(seen.color_errors[-1]))}
            yield {"step": self.num_steps, "num_rays": batch.num_rays} | measured

    @property
    def optimizer(self) -> Optimizer:
        """The optimizer of `steps`.

        Raises:
            InputError: Lightning's Trainer has trained this run with its own optimizer.
        """
        if self._optimizer is None:
            if self.system.train_step.progress.rays_seen:
                raise InputError(
                    "Lightning's Trainer has trained this run, and has its optimizer: save it with "
                    "trainer.save_checkpoint(FILE), and continue with build_run(..., resume=FILE)."
                )
            self.system.to(self.settings.device)
            self._optimizer = self.system.train_step.new_optimizer()
        return self._optimizer

    @property
    def model(self) -> TrainedModel:
        """The current model; it shares its weights with the run."""
        tile_points = self.settings.inference_tile_points
        return TrainedModel(self.system.model.eval(), checkpoint_of(self._content(), Path("the run")), tile_points)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a checkpoint: for `build_run(..., resume=path)`, `Trainer.fit`, `nl.load` and the commands.

        Args:
            path: the file, which is written atomically.

        Raises:
            InputError: the weights are not finite, Lightning's Trainer has trained this run, or the file cannot be
                written.
        """
        if broken := first_not_finite(self.system.train_step.objective.named_weights()):
            raise InputError(f"The weights of {broken} are not finite numbers, so they are not saved. Use {CURE}.")
        training = {
            "epoch": 0,
            LIGHTNING: lightning_version,
            "loops": loops_after(self.num_steps),
            "callbacks": {self.collapse_guard.state_key: self.collapse_guard.state_dict()},
            "optimizer_states": [self.optimizer.state_dict()],
            "lr_schedulers": [],
        }
        write_checkpoint(self._content() | training, Path(path))

    def restore(self, path: str | os.PathLike[str]) -> None:
        """Resume from a checkpoint of this run; see `build_run`."""
        train_step, guard, file = self.system.train_step, self.collapse_guard, Path(path)
        content = content_to_resume(file)
        state, kept = content[KEY], content.get("callbacks", {})
        require_same_capture(state, self.system.record, self.system.resume_changed_capture)
        require_resumable(
            content,
            file,
            weights=self.system.state_dict(),
            optimizer=self.optimizer,
            build=train_step.build_optimizer,
            callbacks=[guard] if guard.state_key in kept else [],  # a Trainer may have trained it without one
            loops=loops_after(0),
            progress=train_step.progress,
            multiple_of=train_step.objective.pixels_per_patch,
        )
        restore_run(state, train_step, train_step.device)
        self.system.load_state_dict(content["state_dict"])
        self.optimizer.load_state_dict(content["optimizer_states"][0])
        guard.load_state_dict(kept.get(guard.state_key, guard.state_dict()))
        self.num_steps = content["global_step"]

    def _content(self) -> dict[str, Any]:
        state, record = self.system.state_dict(), self.system.kept_record()
        return {"state_dict": state, "global_step": self.num_steps, KEY: record}


def build_run(
    *overrides: str,
    scene: Scene | None = None,
    model: Model | None = None,
    loss: Loss | None = None,
    resume: str | os.PathLike[str] | None = None,
) -> StepwiseRun:
    """Build what `nerf train OVERRIDES` trains, for `run.steps(n)` or `Trainer.fit(run.system, run.data)`.

    Nothing is written. The weights depend only on the seed. A run is fitted once; to resume from a checkpoint, build
    another.

    Args:
        *overrides: settings as on the command line, such as "scene=bricks" and "model=nerf_tiny".
        scene: from `scene_from_cameras` or `nl.read`, instead of the config's.
        model: your own model instead of the config's; its weights are drawn anew from the seed. Its checkpoints are
            opened by building it again, as here, with `ckpt_path`, and not by the commands.
        loss: your own loss instead of the config's.
        resume: a checkpoint, or a run folder, that `run.steps` resumes; give the overrides and the scene again. On a
            CPU the weights are then, bit for bit, those of a run that was never stopped.

    Raises:
        InputError: a setting or the capture is invalid, or a setting belongs to Lightning's Trainer.
    """
    _refuse_settings_of_the_trainer(overrides)
    overrides = of_scene(scene, overrides)
    asked = compose_config("train", overrides)
    config = asked.config
    set_limits(Budgets(**config.budgets))
    settings: TrainerSettings = build(config.trainer)
    former = None if resume is None else read_checkpoint(Path(resume), to_resume=True)
    if former is not None:
        settings.keep_precision(former.precision)
        settings.keep_tile(former.tile_points)
    settings.prepare_machine()
    if former is not None:
        asked = replace(asked, resumed=plain_yaml(former.config, str(former.path)))
    config.budget.seconds = None  # Lightning's Trainer, or `steps`, ends it
    planned = plan_run(asked, settings, scene, model, loss)
    guards = planned.config.callbacks
    run = StepwiseRun(**vars(planned), collapse_guard=build(guards.collapse_guard), nan_guard=build(guards.nan_guard))
    settings.prepare(run.system.model)
    run.system.record["precision"] = settings.precision
    if former is not None:
        run.restore(former.path)
    return run


def of_scene(scene: Scene | None, overrides: Sequence[str]) -> tuple[str, ...]:
    """Return overrides for a run whose scene was given from Python, if any."""
    if scene is None:
        return tuple(overrides)
    for override in overrides:
        if key_of(override).partition(".")[0].partition("@")[0] == "scene":
            raise InputError(
                f"{override}: the scene is given, with all its settings (scene=...). Leave one of them out."
            )
    return ("scene=in_memory", f"scene.name={quoted(scene.name)}", *overrides)


def _refuse_settings_of_the_trainer(overrides: Sequence[str]) -> None:
    for override in overrides:
        key = key_of(override)
        for setting, instead in OF_LIGHTNINGS_TRAINER.items():
            if key == setting or key.startswith((f"{setting}.", f"{setting}@")):
                raise InputError(f"{override}: here, this is a setting of Lightning's Trainer: {instead}.")
