"""Files that are written again and again: their names, and what is said where they cannot be written."""

from pathlib import Path


def free_name(folder: Path, stem: str, suffix: str, most: int) -> Path:
    """Return a path with the first number that no file has; names never come from the page.

    Raises:
        OSError: so many there are already, and whoever clicks on would fill the disk.
    """
    for number in range(1, most + 1):
        path = folder / f"{stem}_{number:03d}{suffix}"
        if not path.exists():
            return path
    raise OSError(f"{folder} holds {most} of them, the most that the page writes")


def not_saved(error: OSError) -> str:
    """Return what to tell a person whose file could not be written."""
    return f"It could not be saved: {error}. Make room, or start again with another paths.output_dir=DIR."
