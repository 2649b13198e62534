"""The scene as one page that anyone can open and explore: no server, no network, no program.

`page_file.py` fills in the content; scripts and styles are in `page_files/`.
"""

from dataclasses import dataclass
from pathlib import Path

from nerf_lightning.export.base import MODEL_ALONE, RunContext, require_setting
from nerf_lightning.extensions.splats.comparison import compared
from nerf_lightning.extensions.splats.fitted import SplatFitting, cropped
from nerf_lightning.extensions.splats.page_file import write_page
from nerf_lightning.extensions.splats.page_marks import Marks, read_marks
from nerf_lightning.extensions.splats.quantized import QuantizedSplats
from nerf_lightning.files.html import is_scene_page
from nerf_lightning.files.json_files import write_json
from nerf_lightning.messages.console import StageProgress, say
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import SceneRecord

MARKS = "views.json"  # Kept next to the page.


@dataclass
class PageExport(SplatFitting):
    """Write `page.html`: the scene as splats, with their renderer, the cameras and small photographs.

    Args:
        num_splats: maximum number of splats; auto: 200 times the square root of a view's number of
            pixels, at most 150,000.
        seconds: seconds of fitting the splats to the training photographs; without them, to renders of the
            field; 0: no fitting.
        sh_degree: degree of the spherical harmonics of colors, 0 to 3; 0: the same color from everywhere.
        longest: maximum length of the longer side of the images used for fitting, in pixels.
        max_views: maximum number of held-out views on which the page is compared with the model; 0: none.
        seed: the seed of the initial splats and of the order of views.
        photographs: maximum number of photographs to jump to, spread over all; 0: none.
        title: title of the page; None: the scene's name, or its folder's if the name is only that of its format.
        views: file of named views, notes and distances (see `page_marks`), which is kept as `views.json` next to the
            page; None: that file, if it exists.
        first_view: name of the view or photograph that is shown first; None: the most central training
            photograph.
    """

    plays_path = True

    max_views: int = 8
    photographs: int = 24
    title: str | None = None
    views: str | None = None
    first_view: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_setting("photographs", self.photographs, self.photographs >= 0, "give 0 or more.")

    def export(
        self, model: Model, record: SceneRecord, folder: Path, tile_points: int, run: RunContext = MODEL_ALONE
    ) -> list[Path]:
        """Write the page, and print how its quality compares with the model's."""
        target = folder / "page.html"
        if target.is_dir() or (target.exists() and not is_scene_page(target)):
            kind = "a folder" if target.is_dir() else "a file that is not a page of this program"
            raise InputError(f"{target} is {kind}, and would be lost. Move it away, or give paths.output_dir=DIR.")
        marks = self._marks(record, folder)
        with StageProgress(self.stages()) as report:
            found = self.fitted(model, record, run, tile_points, report)
            splats, facts, said = QuantizedSplats.of(found.gaussians), [], []
            if self.max_views:
                chosen = record.background, self.max_views, tile_points
                comparison = compared(found, splats.gaussians(), model, *chosen, report)
                part = "" if run.crop is None else " (of the whole scene)"
                facts = [(label, f"{fact}{part}") for label, fact in comparison.facts()]
                said = [("PSNR", f"{comparison.psnr()}{part}")]
            splats = splats if run.crop is None else QuantizedSplats.of(cropped(found.gaussians, run))
        fit = ("splats", f"{splats.splats:,}, fitted to {found.truth} for {self.seconds:g} s")
        chosen_texts = marks, self.title, self.first_view
        write_page(target, splats, found.focal, record, run, self.photographs, [*facts, fit], *chosen_texts)
        if self.views is not None:
            write_json(folder / MARKS, marks)
        size = ("size", f"{target.stat().st_size / 1e6:.1f} MB")
        say(*(f"{f'page {name}':<12} {fact}" for name, fact in [size, *said, fit]))
        return [target]

    def _marks(self, record: SceneRecord, folder: Path) -> Marks:
        kept = folder / MARKS
        path = kept if self.views is None else Path(self.views).expanduser()
        if self.views is not None and not path.is_file():
            raise InputError(
                f'what.views={self.views}: there is no such file. The page\'s button "Download views" saves one.'
            )
        marks = read_marks(path if path.is_file() else None, record)
        names = [view["name"] for view in marks["views"]]
        if self.first_view is not None and self.first_view not in (*names, *record.view_names):
            views = f"views: {listed(names)}; " if names else ""
            raise InputError(
                f"what.first_view={self.first_view}: there is no view or photograph of this name. Choose one of them "
                f"({views}photographs: {listed(record.view_names)})."
            )
        return marks
