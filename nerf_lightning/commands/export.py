"""Write what a checkpoint has learnt as a mesh, points, grids, depth maps or cameras."""

from omegaconf import DictConfig

from nerf_lightning.loading import quick_imports


def run(config: DictConfig) -> None:
    """Write the files."""
    with quick_imports():
        from nerf_lightning.commands.exporting import export
        from nerf_lightning.commands.processes import on_all_processes

    on_all_processes("export", config, export)
