"""Find the camera poses of photographs or of a video (structure from motion), so that they can be trained on."""

from omegaconf import DictConfig


def run(config: DictConfig) -> int:
    """Write a COLMAP capture; return the number of photographs whose cameras were found."""
    from nerf_lightning.commands.posing import find_poses

    return find_poses(config)
