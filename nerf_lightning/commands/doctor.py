"""Examine a capture before training: poses, lenses, photographs, near and far, with the cure for what is wrong."""

from omegaconf import DictConfig


def run(config: DictConfig) -> int:
    """Print and write the verdicts; return how many checks found something wrong."""
    from nerf_lightning.commands.diagnosing import diagnose

    return diagnose(config)
