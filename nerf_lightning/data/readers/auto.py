"""A capture of whatever format: the files in its folder tell which."""

import inspect
import logging
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.checks import contents
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.pixels.images import image_size
from nerf_lightning.data.readers.base import Reader
from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.data.readers.colmap import ColmapReader
from nerf_lightning.data.readers.llff import LlffReader
from nerf_lightning.data.readers.transforms import TransformsReader
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.types.scene import Scene

# The file that tells a format, how scene= names it, and who reads it. Where several are there, the first says more:
# a COLMAP model has lenses and points, which poses_bounds.npy beside it lacks.
FORMATS: tuple[tuple[str, str, type[Reader]], ...] = (
    ("transforms_train.json", "blender", BlenderReader),
    ("transforms.json", "transforms", TransformsReader),
    ("sparse/0/cameras.bin", "colmap", ColmapReader),
    ("sparse/0/cameras.txt", "colmap", ColmapReader),
    ("sparse/cameras.bin", "colmap", ColmapReader),
    ("sparse/cameras.txt", "colmap", ColmapReader),
    ("poses_bounds.npy", "llff", LlffReader),
)

MOST_PIXELS = 640
"""Of the longer side of photographs whose size the user leaves open."""

log = logging.getLogger(__name__)


@dataclass
class AutoReader(CaptureReader):
    """Read a folder as the format that its files tell.

    Settings that are left as they are have the values that the format's own reader has.

    Args:
        downscale: whole factor by which the photographs shrink; auto: so that their longer side has at most 640 pixels,
            of which a few minutes on a CPU see enough.
    """

    downscale: int | Literal["auto"] = 1  # type: ignore[assignment]
    name: str = "auto"

    def read(self) -> Scene:
        """Return the capture, as the format's own reader does.

        Raises:
            InputError: no known format, a setting that the format does not have, or anything wrong with the files.
        """
        return self._handy(self.reader()).read()

    def capture(self) -> Capture:
        """Return what the format says, where it is one of photographs with their poses."""
        reader = self.reader()
        if not isinstance(reader, CaptureReader):
            raise InputError(f"{self.root} is no capture of photographs with poses. Name its format with scene=...")
        return reader.capture()

    def reader(self) -> Reader:
        """Return the reader of the format, and say which it is.

        Raises:
            InputError: no known format, or a setting that the format does not have.
        """
        found = self.known_format(self.folder())
        if found is None:
            raise InputError(
                f"{self.root} holds none of {listed(dict.fromkeys(file for file, _, _ in FORMATS))}; it holds "
                f"{contents(self.folder())}. If these are photographs whose cameras nobody knows yet, use scene=photos."
            )
        file, scene, kind = found
        log.info("%s: read as scene=%s, for it has %s", self.root, scene, file)
        chosen = self._chosen() | {"root": self.root, "name": self.name}
        refused = sorted(chosen.keys() - inspect.signature(kind).parameters.keys())
        if refused:
            raise InputError(f"scene.{refused[0]}: scene={scene}, which {self.root} is, has no such setting. Leave it.")
        return kind(**chosen)

    @staticmethod
    def known_format(folder: Path) -> tuple[str, str, type[Reader]] | None:
        """Return which format's file is in a folder, how scene= names it, and its reader; None for no known one."""
        return next((found for found in FORMATS if (folder / found[0]).is_file()), None)

    def _handy(self, reader: Reader) -> Reader:
        if self.downscale != "auto" or not isinstance(reader, CaptureReader):
            return reader
        longest = max(max(image_size(view.photograph.path)) for view in reader.capture().views)
        factor = -(-longest // MOST_PIXELS)
        log.info("downscale: %d, of photographs of up to %d pixels (scene.downscale=N)", factor, longest)
        return replace(reader, downscale=factor)

    def _chosen(self) -> dict[str, Any]:
        """Return the settings that say something."""
        values = {field.name: (getattr(self, field.name), field.default) for field in fields(AutoReader)}
        return {name: value for name, (value, default) in values.items() if value not in (default, "auto")}
