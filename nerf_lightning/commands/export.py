"""Write what a checkpoint has learnt as a mesh, points, grids, depth maps or cameras."""

from omegaconf import DictConfig


def run(config: DictConfig) -> None:
    """Write the files."""
    from nerf_lightning.commands.exporting import export
    from nerf_lightning.commands.processes import on_all_processes

    on_all_processes("export", config, export)
