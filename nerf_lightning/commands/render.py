"""Make a video of a checkpoint along a camera path."""

from omegaconf import DictConfig

from nerf_lightning.loading import quick_imports


def run(config: DictConfig) -> None:
    """Render colour and depth."""
    with quick_imports():
        from nerf_lightning.commands.processes import on_all_processes
        from nerf_lightning.commands.rendering import render

    on_all_processes("render", config, render)
