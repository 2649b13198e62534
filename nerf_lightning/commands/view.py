"""Look around in a checkpoint, in the browser."""

import logging

from omegaconf import DictConfig

from nerf_lightning.loading import quick_imports

log = logging.getLogger(__name__)


def prepare(arguments: list[str]) -> list[str]:
    """Name the run's own scene where the user names none: its photographs are shown where they can be read.

    Raises:
        InputError: the checkpoint cannot be read, or photographs are wished for and nobody knows which.
    """
    from nerf_lightning.commands import eval as evaluation
    from nerf_lightning.errors import InputError

    try:
        return evaluation.prepare(arguments)
    except InputError as error:
        from nerf_lightning.commands.recorded_scene import UnknownScene

        wished = [value for key, _, value in (each.partition("=") for each in arguments) if key == "photographs"]
        if not isinstance(error, UnknownScene) or "true" in map(str.lower, wished[-1:]):
            raise
        if not wished:
            log.warning("The cameras are shown without their photographs: %s", error)
        return ["photographs=false", *arguments]


def run(config: DictConfig) -> None:
    """Show the page until Ctrl-C."""
    with quick_imports():
        from nerf_lightning.commands.viewing import view

    view(config)
