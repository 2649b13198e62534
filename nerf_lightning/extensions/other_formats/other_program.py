"""Captures of other programs with a camera per picture: each format is a row of `FORMATS`."""

import logging
import os
from dataclasses import dataclass
from pathlib import Path

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.extensions.other_formats import (
    bundler,
    meshroom,
    nerfies,
    openmvg,
    opensfm,
    pose_files,
    sdfstudio,
    splat_cameras,
    trajectories,
)
from nerf_lightning.extensions.other_formats.posed import Format, PosedReader
from nerf_lightning.files.signatures import files_with, fits
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed

FORMATS: tuple[Format, ...] = (
    opensfm.FORMAT,
    meshroom.FORMAT,
    openmvg.FORMAT,
    sdfstudio.FORMAT,
    nerfies.FORMAT,
    splat_cameras.FORMAT,
    *pose_files.FORMATS,
    *trajectories.FORMATS,
    bundler.FORMAT,
)
"""If a folder has the files of several, the first one says more."""

log = logging.getLogger(__name__)


@dataclass
class OtherProgramReader(PosedReader):
    """Read one of `FORMATS`, determined by its files."""

    named_by = (".json", ".sfm", ".out", ".log")

    name: str = "other_program"

    @classmethod
    def found_in(cls, folder: Path) -> str | None:
        """Return the file by which a format is recognized, if a folder has it, or is that file itself."""
        found = _detect_format(folder)
        return found[1][0] if found else None

    def capture(self) -> Capture:
        """Return all pictures, in the file's order.

        Raises:
            InputError: the format is unknown, or anything is wrong with the files.
        """
        named, folder = Path(self.root).expanduser(), self.folder()
        found = _detect_format(named if os.path.isfile(named) else folder)
        if found is None:
            programs = listed((form.program for form in FORMATS), len(FORMATS))
            raise InputError(f"{self.root} holds no cameras of {programs}. Give the folder that does.")
        form, names = found
        path = folder / names[0]
        log.info("%s: cameras of %s", path, form.program)
        if names[1:] and not form.one_each:
            log.warning("%s is read, and not %s: scene.root=FILE reads another", path, listed(names[1:], 3))
        return form.read(self, path)


def _detect_format(path: Path) -> tuple[Format, list[str]] | None:
    """Return the format of a file or a folder, and the files with its signature, below the folder."""
    for form in FORMATS:
        for signature in form.signatures:
            if path.is_file() and fits(path, signature):
                return form, [path.name]
            if (names := list(files_with(path, signature))) and form.suits(path):
                return form, names
    return None
