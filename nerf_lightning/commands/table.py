"""Gather measured runs into one table: scene, model, mean and deviation over seeds, beside published numbers."""

from omegaconf import DictConfig

from nerf_lightning.commands.bare_paths import named_paths


def prepare(arguments: list[str]) -> list[str]:
    """Take paths that stand alone for the runs."""
    return named_paths(arguments, "runs", several=True)


def run(config: DictConfig) -> int:
    """Print and write the table; return its number of rows."""
    from nerf_lightning.commands.tabulating import tabulate

    return tabulate(config)
