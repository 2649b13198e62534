"""Write one page of a run: numbers, worst views, truth against render, curves, films, capture, protocol and config."""

from pathlib import Path

from omegaconf import DictConfig

from nerf_lightning.commands.bare_paths import named_paths
from nerf_lightning.errors import InputError


def prepare(arguments: list[str]) -> list[str]:
    """Take a path that stands alone for the run, and name the run's own scene where the user names none."""
    arguments = named_paths(arguments, "run", several=False)
    given = dict(argument.partition("=")[::2] for argument in arguments)
    if "run" not in given or "scene" in given or given.get("doctor", "").lower() == "false":
        return arguments
    from nerf_lightning.commands.recorded_scene import scene_overrides

    try:
        recorded = scene_overrides(str(Path(given["run"].strip("'\"")) / "checkpoints" / "last.ckpt"))
    except InputError:
        return arguments  # the page says so
    return [*recorded, *arguments]


def run(config: DictConfig) -> str:
    """Write the page and return where it is."""
    from nerf_lightning.commands.reporting import report

    return report(config)
