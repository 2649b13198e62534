"""Write what a checkpoint has learnt as a mesh, points, grids, depth maps or cameras."""

import torch
from omegaconf import DictConfig

from nerf_lightning import ranks
from nerf_lightning.checkpoints import read_checkpoint
from nerf_lightning.commands.build import build, load_model
from nerf_lightning.commands.console import say
from nerf_lightning.commands.output_folder import beside_checkpoint, output_folder
from nerf_lightning.commands.processes import on_all_processes
from nerf_lightning.commands.schema import required_path
from nerf_lightning.export.base import Export


def run(config: DictConfig) -> None:
    """Write the files."""
    on_all_processes("export", config, export)


def export(config: DictConfig) -> None:
    """Export a checkpoint; it is all that is needed. One process does it, however many there are."""
    settings = build(config.trainer)
    settings.prepare_machine()
    what: Export = build(config.what)
    checkpoint = read_checkpoint(required_path("ckpt", config.ckpt))
    settings.keep_tile(checkpoint.tile_points)
    folder = output_folder(config.paths.output_dir, beside_checkpoint(checkpoint.path, "export"))
    if not ranks.is_first():
        return
    model = load_model(checkpoint).to(settings.device)
    # In float32, whatever the run was trained in: a surface shows the steps of bfloat16.
    with torch.no_grad():
        written = what.export(model, checkpoint.scene, folder, settings.inference_tile_points)
    say(*map(str, written))
