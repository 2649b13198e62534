"""Keep the pictures of some scored views, evenly spaced, and of the worst.

How many: `num_pictures` and `num_worst` in conf/evaluation/default.yaml.
Their colors of depth and errors: `visualization/pictures.py`.
"""

import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.files.atomic import full_disk_named
from nerf_lightning.files.made_folders import child_of, file_name, make_folder
from nerf_lightning.visualization.pictures import mosaic, panels, save_png

PARTS = ("truth", "render", "depth", "true_depth", "error")
"""What is kept of a view; the true depth only where it is known."""


@dataclass(frozen=True)
class ScoredView:
    """A view, its photograph and its render."""

    truth: Float[Tensor, "height width 3"]
    render: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    """Distance along the ray, in the user's units."""
    opacity: Float[Tensor, "height width"]
    depth_range: tuple[float, float]
    """Near and far of the colors of depth, the same for all views."""
    true_depth: Float[Tensor, "height width"] | None = None
    """As `depth`; inf where there is nothing."""

    def parts(self) -> Iterator[tuple[str, UInt8[Tensor, "_ _ 3"]]]:
        """Yield the view's pictures with their names, one by one."""
        return panels(self.truth, self.render, self.depth, self.opacity, self.depth_range, self.true_depth)


@dataclass
class KeptViews:
    """The pictures that one process keeps while it scores its views."""

    folder: Path
    split: str
    num_worst: int
    worst: list[tuple[float, str, IO[bytes]]] = field(default_factory=list)
    """The views of lowest PSNR so far, with name and pictures; no others are held, since a split may be larger than the
    disk, and these are in unnamed files, since they may exceed memory."""
    parts: dict[str, None] = field(default_factory=dict)
    """Names of the pictures in these files, in their order."""

    def save(self, name: str, view: ScoredView) -> None:
        """Write the pictures of an evenly spaced view."""
        self._write(picture_name(self.split, name), view.parts())

    def watch(self, name: str, psnr: float, view: ScoredView) -> None:
        """Hold a view as long as it may be among the worst."""
        if sum((held[:2] < (psnr, name)) for held in self.worst) >= self.num_worst:
            return
        file = TemporaryFile(dir=make_folder(self.folder))  # noqa: SIM115 (closed where the view is dropped or written)
        for part, picture in view.parts():
            self.parts |= {part: None}
            content = io.BytesIO()  # numpy does not report a disk too full for the last bytes
            np.save(content, picture.numpy())
            with full_disk_named(self.folder):
                file.write(content.getbuffer())
        self.worst = sorted([*self.worst, (psnr, name, file)], key=lambda held: held[:2])
        for _, _, dropped in self.worst[self.num_worst :]:
            dropped.close()
        self.worst = self.worst[: self.num_worst]

    def finish(self, rows: list[dict[str, Any]]) -> list[str]:
        """Write the held views that are among the worst of all processes' rows; return the worst names in order."""
        names = [name for _, name in sorted((row["psnr"], row["name"]) for row in rows)][: self.num_worst]
        for _, name, file in self.worst:
            file.seek(0)
            if name in names:
                parts = ((part, torch.from_numpy(np.load(file))) for part in self.parts)
                self._write(f"worst_{names.index(name) + 1}", parts)
        return names

    def close(self) -> None:
        """Close the held files."""
        for _, _, file in self.worst:
            file.close()

    def _write(self, name: str, parts: Iterable[tuple[str, UInt8[Tensor, "_ _ 3"]]]) -> None:
        """Write each part (`truth.png`, ...) to a folder, and all of them side by side to a file."""
        folder = make_folder(self.folder, "images", "views", name)

        def saved() -> Iterator[tuple[str, Tensor]]:
            for part, picture in parts:
                save_png(folder / f"{part}.png", picture)
                yield part, picture

        save_png(child_of(self.folder, "images", name, ending=".png"), mosaic(saved()))


def picture_name(split: str, view_name: str) -> str:
    """Return the name of a view's pictures, without the file ending.

    >>> picture_name("test", "r_0"), picture_name("test", "test/r_0")
    ('test_r_0', 'test_r_0')
    """
    plain = file_name(view_name)
    return plain if plain.startswith(f"{split}_") else f"{split}_{plain}"
