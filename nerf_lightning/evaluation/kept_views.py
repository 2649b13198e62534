"""Which of the scored views keep their pictures (some, evenly spaced, and the worst), and which pictures those are."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.escaping import for_file_name
from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.visualization.pictures import (
    depth_picture,
    error_picture,
    mosaic,
    save_png,
    to_bytes,
    visible_range,
)

PARTS = ("truth", "render", "depth", "error")


@dataclass(frozen=True)
class ScoredView:
    """A view, its photograph and its render."""

    truth: Float[Tensor, "height width 3"]
    render: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    """Distance along the ray, in the user's units."""
    opacity: Float[Tensor, "height width"]

    def row(self) -> UInt8[Tensor, "taller wider 3"]:
        """Return truth, render, depth and error in a row."""
        return mosaic(self.truth, self.render, self.depth, self.opacity)

    def parts(self) -> dict[str, UInt8[Tensor, "_ _ 3"]]:
        """Return them one by one."""
        near, far = visible_range(self.depth, self.opacity)
        depth = depth_picture(self.depth, near, far, self.opacity)
        error = error_picture(self.truth, self.render)
        return dict(zip(PARTS, (to_bytes(self.truth), to_bytes(self.render), depth, error), strict=True))


def save_view(view: ScoredView, row: Path, parts: Path) -> None:
    """Write the row to a file and each part (`truth.png`, ...) to a folder."""
    save_png(row, view.row())
    for name, picture in view.parts().items():
        save_png(parts / f"{name}.png", picture)


@dataclass
class KeptViews:
    """The pictures that one process keeps while it scores its views."""

    folder: Path
    split: str
    num_worst: int
    worst: list[tuple[float, str, ScoredView]] = field(default_factory=list)
    """The lowest PSNR so far, with name and pictures; no more are held, since a split may be larger than memory."""

    def save(self, name: str, view: ScoredView) -> None:
        """Write the pictures of a view of the even spread."""
        self._write(picture_name(self.split, name), view)

    def watch(self, name: str, psnr: float, view: ScoredView) -> None:
        """Hold a view for as long as it may be among the worst."""
        self.worst = sorted([*self.worst, (psnr, name, view)], key=lambda held: held[:2])[: self.num_worst]

    def finish(self, rows: list[dict[str, Any]]) -> list[str]:
        """Write those that are among the worst of all processes' rows; return the names of these, the worst first."""
        names = [name for _, name in sorted((row["psnr"], row["name"]) for row in rows)][: self.num_worst]
        for _, name, view in self.worst:
            if name in names:
                self._write(f"worst_{names.index(name) + 1}", view)
        return names

    def _write(self, name: str, view: ScoredView) -> None:
        parts = make_folder(self.folder, "images", "views", name)
        save_view(view, self.folder / "images" / f"{name}.png", parts)


def picture_name(split: str, view_name: str) -> str:
    """Return the name of a view's pictures without its ending.

    >>> picture_name("test", "r_0"), picture_name("test", "test/r_0")
    ('test_r_0', 'test_r_0')
    """
    plain = for_file_name(view_name)
    return plain if plain.startswith(f"{split}_") else f"{split}_{plain}"
