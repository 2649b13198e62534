"""The pictures that are kept of a view that was scored: one row for a person, and each part for a page."""

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.export.pictures import depth_picture, error_picture, mosaic, save_png, to_bytes, visible_range

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
