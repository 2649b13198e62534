"""The terminal that progress bars are drawn on."""

from rich.console import Console


def stderr_console() -> Console:
    """Return a console on stderr that stays silent where stderr is not a terminal."""
    console = Console(stderr=True)
    console.quiet = not console.is_terminal
    return console
