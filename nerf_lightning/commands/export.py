"""Write what a checkpoint has learnt as a mesh, points, grids, depth maps or cameras."""

import torch
from omegaconf import DictConfig

from nerf_lightning import ranks
from nerf_lightning.config.instantiate import build
from nerf_lightning.console import say
from nerf_lightning.export.base import Export
from nerf_lightning.runs.output_folder import beside_checkpoint, filled_folder
from nerf_lightning.training.launch.processes import on_all_processes
from nerf_lightning.training.open_checkpoint import open_checkpoint


def run(config: DictConfig) -> None:
    """Write the files."""
    on_all_processes("export", config, export)


def export(config: DictConfig) -> None:
    """Export a checkpoint; it is all that is needed. One process does it, however many there are."""
    if not ranks.is_first():
        return
    what: Export = build(config.what)
    # In float32, whatever the run was trained in: a surface shows the steps of bfloat16.
    opened = open_checkpoint(config, float32=True)
    default = beside_checkpoint(opened.checkpoint.path, "export")
    with torch.no_grad(), filled_folder(config.paths.output_dir, default) as folder:
        written = what.export(opened.model, opened.checkpoint.scene, folder, opened.tile_points)
    if opened.checkpoint.given_cameras is not None:
        say("the cameras are those that training refined (refinement=...), not those that were read")
    say(*map(str, written))
