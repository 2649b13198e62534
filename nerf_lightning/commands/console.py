"""The terminals that results and tables are printed to and progress bars are drawn on."""

from rich.console import Console

from nerf_lightning import ranks
from nerf_lightning.escaping import for_terminal


def say(*lines: str) -> None:
    """Print lines to stdout; whatever they name, each stays one line, and steers no terminal."""
    print("\n".join(map(for_terminal, lines)), flush=True)


class StdoutConsole(Console):
    """A console on stdout. Where that is a closed pipe, rich would exit with 1; closed_pipe.py decides here."""

    def on_broken_pipe(self) -> None:
        """Pass on the error that is being handled."""
        raise


def stderr_console() -> Console:
    """Return a console on stderr, silent where that is not a terminal, and in all processes of a run but the first."""
    console = Console(stderr=True)
    console.quiet = not (console.is_terminal and ranks.is_first())
    return console
