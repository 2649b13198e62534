"""Names for files that are written again and again."""

from pathlib import Path


def free_name(folder: Path, stem: str, suffix: str) -> Path:
    """Return a path with the first number that no file has; names never come from the page."""
    number = 1
    while (folder / f"{stem}_{number:03d}{suffix}").exists():
        number += 1
    return folder / f"{stem}_{number:03d}{suffix}"
