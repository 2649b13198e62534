"""Files that are written again and again: their names, and what is said where they cannot be written."""

from pathlib import Path


def free_name(folder: Path, stem: str, suffix: str) -> Path:
    """Return a path with the first number that no file has; names never come from the page."""
    number = 1
    while (folder / f"{stem}_{number:03d}{suffix}").exists():
        number += 1
    return folder / f"{stem}_{number:03d}{suffix}"


def not_saved(error: OSError) -> str:
    """Return what to tell a person whose file could not be written."""
    return f"It could not be saved: {error}. Make room, or start again with another paths.output_dir=DIR."
