"""Measure a checkpoint: PSNR, SSIM, LPIPS, and depth and normals where the truth is known."""

from omegaconf import DictConfig


def prepare(arguments: list[str]) -> list[str]:
    """Name the run's own scene where the user names none, so that the checkpoint is enough.

    The scene's class comes from our conf/, by the name that the checkpoint recorded; only plain values (paths, sizes,
    background) are taken from the file, and the user's overrides come after them.
    """
    given = [argument.partition("=") for argument in arguments]
    checkpoints = [value for key, _, value in given if key == "ckpt"]
    named = any(key in ("scene", "--help", "-h", "-m", "--multirun") for key, _, _ in given)
    if named or len(checkpoints) != 1:
        return arguments
    from nerf_lightning.commands.recorded_scene import scene_overrides

    return [*scene_overrides(checkpoints[0]), *arguments]


def run(config: DictConfig) -> float:
    """Measure and return the PSNR."""
    from nerf_lightning.commands.evaluating import evaluate

    return evaluate(config)
