"""Measure a checkpoint: PSNR, SSIM, LPIPS, and depth and normals where the truth is known."""

import torch
from omegaconf import DictConfig

from nerf_lightning.checkpoints import read_checkpoint
from nerf_lightning.commands.build import build, load_model
from nerf_lightning.commands.console import say
from nerf_lightning.commands.finish import metric_lines
from nerf_lightning.commands.output_folder import beside_checkpoint, output_folder
from nerf_lightning.commands.processes import on_all_processes
from nerf_lightning.commands.protocol import measured_of
from nerf_lightning.commands.recorded_frame import in_recorded_frame
from nerf_lightning.commands.schema import required_path


def run(config: DictConfig) -> float:
    """Measure and return the PSNR."""
    return on_all_processes("eval", config, evaluate)


def evaluate(config: DictConfig) -> float:
    """Measure a checkpoint on a split of a scene; return the PSNR."""
    settings = build(config.trainer)
    settings.prepare_machine()
    checkpoint = read_checkpoint(required_path("ckpt", config.ckpt))
    settings.keep_tile(checkpoint.tile_points)
    model = settings.prepare(load_model(checkpoint))
    folder = output_folder(config.paths.output_dir, beside_checkpoint(checkpoint.path, "evaluation"))
    scene = in_recorded_frame(build(config.scene).read(), checkpoint.scene)
    origin = measured_of(model, checkpoint.config, checkpoint.choices, settings.device, settings.precision)
    scoring, tile_points = build(config.evaluation), settings.inference_tile_points
    with torch.no_grad():
        metrics = scoring.score(model, scene, scene.background, tile_points, folder, origin)
    say(*metric_lines(metrics, folder))
    return float(metrics["psnr"])
