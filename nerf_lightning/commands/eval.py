"""Measure a checkpoint: PSNR, SSIM, LPIPS, and depth and normals where the truth is known."""

from omegaconf import DictConfig

from nerf_lightning.errors import InputError
from nerf_lightning.loading import quick_imports


def prepare(arguments: list[str]) -> list[str]:
    """Name the run's own scene where the user names none, so that the checkpoint is enough.

    The scene's class comes from our conf/, by the name that the checkpoint recorded; only plain values (paths, sizes,
    background) are taken from the file, and the user's overrides come after them.
    """
    given = [argument.partition("=") for argument in arguments]
    checkpoints = [value for key, _, value in given if key == "ckpt"]
    if not checkpoints or any(key in ("scene", "--help") for key, _, _ in given):
        return arguments
    if "," in checkpoints[-1]:
        raise InputError("A sweep over checkpoints needs the scene by name: add scene=... and its settings.")
    with quick_imports():
        from nerf_lightning.commands.recorded_scene import scene_overrides

    return [*scene_overrides(checkpoints[-1]), *arguments]


def run(config: DictConfig) -> float:
    """Measure and return the PSNR."""
    with quick_imports():
        from nerf_lightning.commands.evaluating import evaluate
        from nerf_lightning.commands.processes import on_all_processes

    return on_all_processes("eval", config, evaluate)
