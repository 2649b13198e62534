"""Which step each exported file and film shows: `steps.json` beside them, as times of files do not survive a copy."""

from collections.abc import Iterable
from pathlib import Path

from nerf_lightning.files.json_files import number, read_json_object, write_json

STEPS = "steps.json"


def record_steps(folder: Path, files: Iterable[Path], step: int) -> None:
    """Record that these files, or folders, in a folder show the model after a step."""
    names = {file.relative_to(folder).parts[0] for file in files}
    write_json(folder / STEPS, read_steps(folder) | dict.fromkeys(sorted(names), step))


def exported_files(folder: Path) -> list[Path]:
    """Return the files of a folder of exports, which may be missing."""
    return [file for file in sorted(folder.glob("*")) if file.is_file() and file.name != STEPS]


def read_steps(folder: Path) -> dict[str, int]:
    """Return the recorded step of each file in a folder; what is not recorded is missing."""
    steps = {name: number(step) for name, step in read_json_object(folder / STEPS).items()}
    return {name: int(step) for name, step in steps.items() if step is not None}
