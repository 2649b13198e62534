"""The terminal that progress bars are drawn on."""

from rich.console import Console

from nerf_lightning import ranks


def stderr_console() -> Console:
    """Return a console on stderr, silent where that is not a terminal, and in all processes of a run but the first."""
    console = Console(stderr=True)
    console.quiet = not (console.is_terminal and ranks.is_first())
    return console
