"""Evaluate a checkpoint: PSNR, SSIM, LPIPS, and errors of depth and normals if ground truth is known.

What is measured by default: `conf/evaluation/default.yaml`; how: `evaluation/`; the lines it prints:
`evaluation/main_numbers.py`.
"""

import torch
from omegaconf import DictConfig

from nerf_lightning.config.instantiate import build
from nerf_lightning.config.open_checkpoint import as_known, open_checkpoint
from nerf_lightning.evaluation.main_numbers import metric_lines
from nerf_lightning.evaluation.protocol import measured_of
from nerf_lightning.messages.console import say
from nerf_lightning.runs.command_folder import beside_checkpoint, filled_folder
from nerf_lightning.training.launch.processes import on_all_processes


def run(config: DictConfig) -> float:
    """Measure and return the PSNR (dB)."""
    return on_all_processes("eval", config, evaluate)


def evaluate(config: DictConfig) -> float:
    """Measure a checkpoint on a split of a scene; return the PSNR (dB)."""
    opened = open_checkpoint(config)
    settings, checkpoint, model = opened.settings, opened.checkpoint, opened.model
    with filled_folder(config.paths.output_dir, beside_checkpoint(checkpoint.path, "evaluation")) as folder:
        scene = as_known(build(config.scene).read(), opened)
        origin = measured_of(
            model, checkpoint.config, checkpoint.choices, settings.device, settings.precision, checkpoint.step
        )
        if model.needs_photographs:
            origin["trained_on"] = list(checkpoint.scene.trained_captures)
        scoring = build(config.evaluation)
        with torch.no_grad():
            metrics = scoring.score(model, scene, scene.background, opened.tile_points, folder, origin)
    say(*metric_lines(metrics, folder, scene.pixels.has_transparency))
    return float(metrics["psnr"])
