"""Measure a checkpoint: PSNR, SSIM, LPIPS, and depth and normals where the truth is known."""

import torch
from omegaconf import DictConfig

from nerf_lightning.commands.build import build
from nerf_lightning.commands.console import say
from nerf_lightning.commands.finish import metric_lines
from nerf_lightning.commands.open_checkpoint import open_checkpoint
from nerf_lightning.commands.output_folder import beside_checkpoint, output_folder
from nerf_lightning.commands.processes import on_all_processes
from nerf_lightning.commands.protocol import measured_of
from nerf_lightning.commands.recorded_frame import in_recorded_frame


def run(config: DictConfig) -> float:
    """Measure and return the PSNR."""
    return on_all_processes("eval", config, evaluate)


def evaluate(config: DictConfig) -> float:
    """Measure a checkpoint on a split of a scene; return the PSNR."""
    opened = open_checkpoint(config)
    settings, checkpoint, model = opened.settings, opened.checkpoint, opened.model
    folder = output_folder(config.paths.output_dir, beside_checkpoint(checkpoint.path, "evaluation"))
    scene = in_recorded_frame(build(config.scene).read(), checkpoint.scene)
    origin = measured_of(model, checkpoint.config, checkpoint.choices, settings.device, settings.precision)
    with torch.no_grad():
        scored = model, scene, scene.background, opened.tile_points, folder, origin
        metrics = build(config.evaluation).score(*scored)
    say(*metric_lines(metrics, folder))
    return float(metrics["psnr"])
