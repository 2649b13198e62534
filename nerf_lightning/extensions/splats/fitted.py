"""Fit splats to a trained field and its photographs: the base of splat exports."""

import logging
import math
from dataclasses import dataclass, replace
from typing import Literal

import torch

from nerf_lightning.export.base import Export, Neutral, Report, RunContext, require_kernels, require_setting
from nerf_lightning.extensions.splats.fit import Fitting, fit
from nerf_lightning.extensions.splats.gaussians import Gaussians
from nerf_lightning.extensions.splats.initialize import COUNT, initial_gaussians, look_around
from nerf_lightning.extensions.splats.views import View, photographed, without_lens
from nerf_lightning.messages.console import spoken
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.panoramas import faces_of_panoramas
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import Cameras, Scene, SceneRecord
from nerf_lightning.visualization.pictures import to_bytes

ROOM = "nerf_lightning.extensions.splats"
KERNELS = (f"{ROOM}.projection", f"{ROOM}.tiles")
PER_SIDE, MOST = 200, 150_000
MOST_SHOWN = 3_000_000  # 500 MB as PLY.

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FittedSplats:
    """Splats, and what they were fitted to."""

    gaussians: Gaussians
    scene: SceneRecord
    """The views on which splats and field are compared: a `Scene`, if there are photographs."""
    pinholes: Cameras
    """Their cameras without lenses."""
    truth: Literal["photographs", "the field"]
    """What they were fitted to."""

    @property
    def focal(self) -> float:
        """Mean focal length in pixels of the pictures that they were fitted to."""
        return float(self.pinholes.focal.mean())


@dataclass
class SplatFitting(Export):
    """An exporter that fits splats: its settings, and the fitting."""

    needs_photographs = True
    crops = True
    kernels = KERNELS

    num_splats: int | Literal["auto"] = "auto"
    seconds: float = 60.0
    sh_degree: int = 2
    longest: int = 800
    max_views: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        shown = self.num_splats == "auto" or 1 <= self.num_splats <= MOST_SHOWN
        rule = f"give 1 to {MOST_SHOWN:,} splats, which is what viewers show, or auto."
        require_setting("num_splats", self.num_splats, shown, rule)
        require_setting("seconds", self.seconds, self.seconds >= 0, "give seconds of fitting, 0 or more.")
        require_setting("sh_degree", self.sh_degree, 0 <= self.sh_degree <= 3, "give 0, 1, 2 or 3.")
        require_setting("longest", self.longest, self.longest >= 16, "give 16 pixels or more.")
        require_setting("max_views", self.max_views, self.max_views >= 0, "give 0 or more.")

    def stages(self) -> dict[str, float]:
        """Return the approximate seconds of each stage, in their order."""
        return {"surfaces": 60.0, "fitting": self.seconds, "comparing": 4.0 * self.max_views}

    def fitted(
        self, model: Model, record: SceneRecord, run: RunContext, tile_points: int, report: Report
    ) -> FittedSplats:
        """Return splats that begin on the field's surfaces, fitted to the photographs.

        Without photographs, or if the model's correction of each photograph cannot be undone, they are fitted to
        renders of the field.
        """
        for module in self.kernels:
            require_kernels(module, "Fitting splats")
        photographs = _photographs(record, run)
        if record.cameras.lens_model == "equirectangular":
            record, photographs = as_faces(record), None
        scene = record if photographs is None else photographs
        pinholes = without_lens(scene.cameras, self.longest)
        budget = self._budget(pinholes)
        compared = f", and the model is rendered in up to {self.max_views} views to compare" if self.max_views else ""
        steps = f"{COUNT} renders of the model, then {spoken(self.seconds)} of fitting (what.seconds){compared}"
        log.info("splats: %s", steps)
        around = look_around(model, record, tile_points, self.seed, report)
        first = max(1, budget // 2) if self.seconds else budget
        gaussians = initial_gaussians(around, first, self.sh_degree, self.seed, run.min_opacity)
        cropped(gaussians, run)  # refuses an empty box before the fitting, not after it
        if self.seconds:
            views = [] if photographs is None else training_views(record, photographs, pinholes, run.neutral)
            fitting = Fitting(budget, self.seconds, record.background, extent(pinholes), self.seed)
            with torch.enable_grad():
                gaussians = fit(gaussians, views, around.views(), fitting, report)
        return FittedSplats(gaussians, scene, pinholes, "the field" if photographs is None else "photographs")

    def _budget(self, pinholes: Cameras) -> int:
        pixels = int((pinholes.width * pinholes.height).double().mean())
        return min(PER_SIDE * math.isqrt(pixels), MOST) if self.num_splats == "auto" else self.num_splats


def cropped(gaussians: Gaussians, run: RunContext) -> Gaussians:
    """Return the splats whose centers are in the crop box, if there is one.

    Raises:
        InputError: none is.
    """
    if run.crop is None:
        return gaussians
    inside = run.crop.holds(gaussians.means)
    if not inside.any():
        raise InputError("crop: there are no splats in this box. Its corners are in the capture's own frame.")
    return gaussians.map(lambda each: each[inside])


def _photographs(record: SceneRecord, run: RunContext) -> Scene | None:
    name = record.view_names[record.splits["train"][0]]
    unknown = run.neutral is not None and run.neutral(torch.zeros(1, 1, 3), name) is None
    return None if unknown else run.photographs


def as_faces(record: SceneRecord) -> SceneRecord:
    """Replace each panorama of a record by six cube faces: splats are fitted to pinhole pictures."""
    views = torch.arange(len(record.view_names)).repeat_interleave(6)
    return replace(
        record,
        cameras=faces_of_panoramas(record.cameras),
        near=record.near[views],
        far=record.far[views],
        view_names=tuple(f"{record.view_names[view]}, face {face % 6}" for face, view in enumerate(views.tolist())),
        splits={name: tuple(6 * k + i for k in split for i in range(6)) for name, split in record.splits.items()},
    )


def training_views(record: SceneRecord, scene: Scene, pinholes: Cameras, neutral: Neutral | None = None) -> list[View]:
    """Return the photographs that the model was trained on, by its record, except fully masked ones.

    `neutral` undoes its learned correction of each.
    """
    trained = {record.view_names[view] for view in record.splits["train"]}
    known = [view for view in scene.splits["train"] if scene.view_names[view] in trained]
    views = []
    for number in known:
        view = photographed(scene, number, pinholes)
        if neutral is not None:
            rgb = neutral(view.rgba[..., :3] / 255.0, scene.view_names[number])
            assert rgb is not None  # otherwise nothing is fitted to photographs
            view = replace(view, rgba=torch.cat([to_bytes(rgb), view.rgba[..., 3:]], dim=-1))
        if view.mask is None or bool(view.mask.any()):
            views.append(view)
    return views


def extent(cameras: Cameras) -> float:
    """Return the maximum distance of the cameras from their center (scene units)."""
    eyes = cameras.c2w[:, :, 3]
    return max(float((eyes - eyes.mean(dim=0)).norm(dim=-1).max()), 1e-6)
