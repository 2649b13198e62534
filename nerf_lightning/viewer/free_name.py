"""Files that are written again and again: their names, and what is said where they cannot be written."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def free_name(folder: Path, stem: str, ending: str, most: int) -> Iterator[Path]:
    """Lend a path with the first number that no file has; names never come from the page.

    An empty file keeps the name, so that of several browsers that save at once each has its own; it goes where the
    block fails.

    Raises:
        OSError: so many there are already, and whoever clicks on would fill the disk; or it cannot be made.
    """
    path = _made(folder, stem, ending, most)
    try:
        yield path
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def _made(folder: Path, stem: str, ending: str, most: int) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(1, most + 1):
        path = folder / f"{stem}_{number:03d}{ending}"
        with suppress(FileExistsError):
            path.touch(exist_ok=False)
            return path
    raise OSError(f"{folder} holds {most} of them, the most that the page writes")


def not_saved(error: OSError) -> str:
    """Return what to tell a person whose file could not be written."""
    return f"It could not be saved: {error}. Make room, or start again with another paths.output_dir=DIR."
