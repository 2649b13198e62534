"""The end of a training run: test metrics, the video, the film of how a view improved, and a summary for the user.

What is measured and filmed by default: `evaluation`, `path` and `final` in conf/train.yaml.
The result in a sentence, and what would improve it: `show.py`.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Trainer
from omegaconf import DictConfig

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.compute import ranks
from nerf_lightning.config.exporters import exporters_after_training
from nerf_lightning.config.instantiate import build
from nerf_lightning.data.captures.joined import shown_capture
from nerf_lightning.data.pixels.picture_files import read_rgba
from nerf_lightning.evaluation.evaluator import Scoring
from nerf_lightning.evaluation.main_numbers import metric_lines
from nerf_lightning.evaluation.protocol import measured_of
from nerf_lightning.export.base import Export
from nerf_lightning.messages.console import say
from nerf_lightning.nerf.models.base import Model, point_field, show_photographs
from nerf_lightning.nerf.refinements.displacements import camera_displacements, far_displaced
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.runs.file_steps import record_steps
from nerf_lightning.training.callbacks.hparams import FINAL_METRICS
from nerf_lightning.training.launch.trainer import TrainerSettings
from nerf_lightning.video.encoding import require_ffmpeg, write_video
from nerf_lightning.video.film import film, require_room
from nerf_lightning.video.paths.base import CameraPath
from nerf_lightning.video.settings import FilmSettings
from nerf_lightning.video.shots import Subject, lay_path
from nerf_lightning.visualization.pictures import at_most

PROGRESS, PROGRESS_FPS = "progress.mp4", 4
MOST_NAMED = 10


@dataclass
class PostTraining:
    """The steps after training; built before it, so that bad input is reported at once."""

    scoring: Scoring | None
    path: CameraPath | None
    exports: dict[str, Export]
    """By name; the command writes them after everything here."""

    @classmethod
    def from_config(cls, config: DictConfig) -> "PostTraining":
        """Build what the config specifies."""
        scoring, path = build(config.evaluation), build(config.path)
        if config.final.video:
            require_ffmpeg()
        exports = exporters_after_training(config.final)
        return cls(scoring if config.final.evaluate else None, path if config.final.video else None, exports)

    def require_density(self, model: Model) -> None:
        """Refuse exports that need a density if the model has none."""
        if any(export.needs_density for export in self.exports.values()):
            point_field(model)

    def require_film(self, scene: Scene) -> None:
        """Refuse a path that does not fit around the scene, or frames that do not fit into memory."""
        if self.path is not None:
            record = scene_record(shown_capture(scene))
            require_room(lay_path(self.path, record), FilmSettings())

    def __call__(
        self, settings: TrainerSettings, scene: Scene, model: Model, trainer: Trainer, folder: Path
    ) -> float | None:
        """Evaluate, film, print a summary, and return the test PSNR (else the validation's)."""
        settings.prepare(model).eval()
        lines, psnr = [], trainer.callback_metrics.get("val/psnr")
        tile_points = settings.inference_tile_points
        scene, moved = _with_learnt_cameras(scene, trainer)
        with torch.no_grad():
            if self.scoring is not None and not scene.splits.get(self.scoring.split):
                lines.append(f"not measured: the scene has no {self.scoring.split} views")
            elif self.scoring is not None:
                system: Any = trainer.lightning_module
                config, choices = system.record["config"], system.record["choices"]
                how = settings.device, settings.precision, trainer.global_step
                origin = measured_of(model, config, choices, *how)
                metrics = self.scoring.score(model, scene, scene.background, tile_points, folder, origin)
                psnr = metrics["psnr"]
                final = {name: metrics[name.partition("/")[2]] for name in FINAL_METRICS}
                for logger in trainer.loggers:
                    logger.log_metrics({name: v for name, v in final.items() if v is not None}, trainer.global_step)
                lines += metric_lines(metrics, folder, scene.pixels.has_transparency)
            if self.path is not None:
                shown_scene = shown_capture(scene)
                show_photographs(model, shown_scene)
                subject = Subject(model, scene_record(shown_scene), scene.background)
                shown = FilmSettings(precision=settings.precision)
                video, depth = film([subject], self.path, tile_points, folder, shown)
                lines += [f"video        {video}", f"depth        {depth}"]
                if ranks.is_first():
                    lines += _film_progress(folder)
                    record_steps(folder, [video, depth, folder / PROGRESS], trainer.global_step)
        lines += moved
        lines.append(f"checkpoint   {folder / 'checkpoints' / 'last.ckpt'}")
        if (folder / "tensorboard").is_dir():
            lines.append(f"TensorBoard  tensorboard --logdir {folder / 'tensorboard'}")
        say(*lines)
        return None if psnr is None else float(psnr)


def _with_learnt_cameras(scene: Scene, trainer: Trainer) -> tuple[Scene, list[str]]:
    """Return the scene with the cameras that the run has learned, and the lines of the summary about them."""
    system: Any = trainer.lightning_module
    trained = scene.splits["train"]
    learnt = system.rays.refined(trained)
    if learnt is None:
        return scene, []
    extent = float((scene.aabb[1] - scene.aabb[0]).norm()) / 2.0
    motion = camera_displacements(scene.cameras, learnt, trained, extent)
    lines = [
        f"cameras      refined: half of them moved by more than {float(motion.median()):.2%} of the scene's extent"
    ]
    far = far_displaced(motion)
    if far:
        names = [f"{scene.view_names[trained[place]]} ({float(motion[place]):.1%})" for place in far[:MOST_NAMED]]
        more = f" and {len(far) - MOST_NAMED} more" if len(far) > MOST_NAMED else ""
        lines.append(f"             far more than that; check their poses: {', '.join(names)}{more}")
    return replace(scene, cameras=learnt, refined=True), lines


def _film_progress(folder: Path) -> list[str]:
    """Join the pictures of one view from training into a film; return the summary line with its path."""
    files = sorted((folder / "images" / "progress").glob("step_*.png"))
    if len(files) < 2:
        return []
    frames = [at_most(torch.from_numpy(read_rgba(file)[..., :3].copy())) for file in files]
    write_video(folder / PROGRESS, frames, PROGRESS_FPS, len(frames))
    return [f"progress     {folder / PROGRESS}"]
