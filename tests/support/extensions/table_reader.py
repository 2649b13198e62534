"""Photographs whose cameras stand in a table, cameras.csv: file, focal length in pixels, position, what it looks at."""

import csv
from dataclasses import dataclass

import torch

from nerf_lightning.data.captures.capture import Capture, View
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.pixels.decoded_photographs import Photograph
from nerf_lightning.data.pixels.picture_files import image_size
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.poses import look_at


@dataclass
class TableReader(CaptureReader):
    """A capture with a table of cameras; z is up.

    Args:
        file: the table, in root.
    """

    file: str = "cameras.csv"

    def capture(self):
        path = self.folder() / self.file
        try:
            with path.open(newline="", encoding="utf-8") as rows:
                return Capture(tuple(self._view(row) for row in csv.reader(rows)), source=path)
        except (OSError, ValueError, csv.Error) as error:
            raise InputError(f"{path} is no table of cameras: {error}. Each row is file,focal,x,y,z,x,y,z.") from error

    def _view(self, row):
        name, *numbers = row
        focal, *position, to_x, to_y, to_z = map(float, numbers)
        photograph = self.folder() / name
        width, height = map(float, image_size(photograph))
        eye, target, up = torch.tensor([position, [to_x, to_y, to_z], [0.0, 0.0, 1.0]], dtype=torch.float64)
        return View(
            name=name,
            photograph=Photograph(photograph),
            c2w=look_at(eye, target, up),
            focal=(focal, focal),
            center=(width / 2, height / 2),
            size=(width, height),
        )
