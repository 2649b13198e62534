"""Look around in a checkpoint, in the browser."""

from omegaconf import DictConfig


def prepare(arguments: list[str]) -> list[str]:
    """Name the run's own scene where the user names none: its photographs are shown where they can be read."""
    from nerf_lightning.commands import eval as evaluation
    from nerf_lightning.errors import InputError

    try:
        return evaluation.prepare(arguments)
    except InputError:
        # A checkpoint that cannot be read is said when it is; one whose scene is unknown has no photographs.
        return [*arguments, "photographs=false"]


def run(config: DictConfig) -> None:
    """Show the page until Ctrl-C."""
    from nerf_lightning.commands.viewing import view

    view(config)
