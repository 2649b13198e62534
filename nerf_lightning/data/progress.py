"""Progress bars on stderr, for work that a person would otherwise wait for in the dark."""

from rich.console import Console
from rich.progress import Progress, ProgressColumn


def progress_bar(*columns: ProgressColumn | str, shown: bool = True) -> Progress:
    """Return a bar that vanishes when it is done; it stays silent where stderr is not a terminal."""
    console = Console(stderr=True)
    return Progress(*columns, console=console, transient=True, disable=not (shown and console.is_terminal))
