"""The scene as one page that anyone can open and walk around in: no server, no network, no program."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from nerf_lightning.export.baking.bake import bake
from nerf_lightning.export.baking.cost import measured_cost
from nerf_lightning.export.baking.fitting import fitted
from nerf_lightning.export.baking.marcher import Marcher
from nerf_lightning.export.base import Export, require_setting
from nerf_lightning.export.page_file import is_page, write_page
from nerf_lightning.export.page_marks import Marks, read_marks
from nerf_lightning.export.voxel_kernels.layout import ROOM
from nerf_lightning.files.json_files import write_json
from nerf_lightning.messages.console import StageProgress, say
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import SceneRecord, Space

Quality = Literal["small", "medium", "large"]
MARKS = "views.json"  # What is kept next to the page.
QUALITIES: tuple[Quality, ...] = get_args(Quality)
# Voxels along the longest side of what there is,
RESOLUTIONS: dict[Space, dict[Quality, int]] = {
    "bounded": {"small": 128, "medium": 216, "large": 320},
    "ndc": {"small": 128, "medium": 216, "large": 320},
    "contracted": {"small": 108, "medium": 160, "large": 192},
}
# and spherical harmonics of its colors: without bounds much is fog, which hides less what changes with the direction.
HARMONICS: dict[Space, dict[Quality, int]] = {
    "bounded": {"small": 4, "medium": 4, "large": 9},
    "ndc": {"small": 4, "medium": 4, "large": 9},
    "contracted": {"small": 4, "medium": 9, "large": 9},
}
BAKING = {"box": 1.0, "coarse": 1.0, "density": 4.0, "lit": 4.0, "seen": 10.0, "colors": 15.0}
COSTS = BAKING | {"fitted": 20.0, "measured": 8.0}


@dataclass
class PageExport(Export):
    """Write `page.html`: the field as bytes, with what marches through them, the cameras and small photographs.

    Args:
        quality: small, medium or large: about 3, 10 or 30 MB.
        resolution: voxels along the longest side of the content; in unbounded scenes, three quarters of them lie along
            the side of the box, and as many around it. None: as the quality.
        photographs: maximum number of photographs to jump to, spread over all; 0: none.
        max_views: maximum number of test views on which the page is compared with the model; 0: none.
        fit_steps: steps that fit the voxels to the training photographs; 0: none, as without photographs or with a
            correction per photograph.
        title: title of the page; None: the scene's name, or its folder's if the name is only that of its format.
        views: file of named views, notes and distances (see `page_marks`), which is kept as `views.json` next to the
            page; None: that file, if it exists.
        first_view: name of the view or photograph that is shown first; None: the most central training
            photograph.
    """

    needs_photographs = True
    plays_path = True
    kernels = tuple(f"{ROOM}.{module}" for module in ("bounded", "contracted", "gradients"))

    quality: Quality = "medium"
    resolution: int | None = None
    photographs: int = 24
    max_views: int = 8
    fit_steps: int = 60
    title: str | None = None
    views: str | None = None
    first_view: str | None = None

    def __post_init__(self) -> None:
        enough = self.resolution is None or self.resolution >= 8
        require_setting("resolution", self.resolution, enough, "give 8 voxels or more, or null for what.quality's.")
        for name in ("photographs", "max_views", "fit_steps"):
            value = getattr(self, name)
            require_setting(name, value, value >= 0, "give 0 or more.")
        self.needs_photographs = bool(self.photographs or self.max_views or self.fit_steps)

    def export(self, model: Model, record: SceneRecord, folder: Path, tile_points: int) -> list[Path]:
        """Write the page, and say what it costs."""
        target = folder / "page.html"
        if target.is_dir() or (target.exists() and not is_page(target)):
            kind = "a folder" if target.is_dir() else "a file that is not a page of this program"
            raise InputError(f"{target} is {kind}, and would be lost. Move it away, or give paths.output_dir=DIR.")
        marks = self._marks(record, folder)
        with StageProgress(COSTS) as report:
            resolution = self.resolution or RESOLUTIONS[record.space][self.quality]
            baked = bake(model, record, resolution, HARMONICS[record.space][self.quality], tile_points, report)
            photographs = None if self.beside.corrected else self.beside.photographs
            if photographs is not None:
                baked = fitted(baked, photographs, record, self.fit_steps, report)
            marcher = Marcher(baked)
            cost = measured_cost(marcher, model, record, self.beside.photographs, self.max_views, tile_points, report)
        chosen = (marks, self.title, self.first_view)
        write_page(target, marcher, record, self.beside, self.photographs, cost.facts(), *chosen)
        if self.views is not None:
            write_json(folder / MARKS, marks)
        size = f"{target.stat().st_size / 1e6:.1f} MB (what.quality={self.quality})"
        say(*(f"{name:<12} {fact}" for name, fact in [("size", size), *cost.facts()]))
        return [target]

    def _marks(self, record: SceneRecord, folder: Path) -> Marks:
        kept = folder / MARKS
        path = kept if self.views is None and kept.is_file() else self.views and Path(self.views).expanduser()
        marks = read_marks(path or None, record)
        names = [view["name"] for view in marks["views"]]
        if self.first_view is not None and self.first_view not in (*names, *record.view_names):
            views = f"views: {listed(names)}; " if names else ""
            raise InputError(
                f"what.first_view={self.first_view}: there is no view or photograph of this name. Choose one of them "
                f"({views}photographs: {listed(record.view_names)})."
            )
        return marks
