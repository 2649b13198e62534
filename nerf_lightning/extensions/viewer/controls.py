"""The panel of the page: channels, photographs, the camera path, the crop box, snapshots, exports."""

import math
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch

from nerf_lightning.extensions.viewer.channels import CHANNELS, DEPTH, NORMALS, depth_scale
from nerf_lightning.extensions.viewer.client import ViewerClient
from nerf_lightning.extensions.viewer.export_panel import ExportPanel
from nerf_lightning.extensions.viewer.frusta import Frusta
from nerf_lightning.extensions.viewer.path_panel import PathPanel
from nerf_lightning.extensions.viewer.photograph_panel import PhotographPanel
from nerf_lightning.extensions.viewer.renderer import View
from nerf_lightning.extensions.viewer.training_switch import TrainingPanel, TrainingSwitch
from nerf_lightning.nerf.geometry.clipping import CropBox
from nerf_lightning.nerf.geometry.world_frame import points_to_user
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.video.paths.recorded_path import RecordedPath, error_message, new_file
from nerf_lightning.visualization.pictures import save_png

LEAST_DEGREES, MOST_DEGREES = 10.0, 120.0
STYLE = Path(__file__).parent / "panel.css"
PHONE = 0.8  # Width over height of windows on phones; their pixels are as many as a desktop's.
SAVE = "Save picture"  # Names are those of exported pages.
LEAST_SHARE = 0.01  # The crop box keeps at least this share of the scene's box along each axis.
MOVES = "Drag to rotate, drag with the right button to move, scroll to zoom. W A S D Q E fly."
MOVES_BY_TOUCH = "One finger rotates; two move and zoom."
NO_CROP = "Not here: a forward-facing capture has no box of its own. `nerf render crop=...` cuts its films."


class Controls:
    """The panel of one user, whose initial vertical field of view is `fov` (radians).

    Their files are saved in `folder`; the files of the folder `exports` can be downloaded.
    """

    def __init__(
        self,
        session: ViewerClient,
        folder: Path,
        fov: float,
        training: TrainingSwitch | None = None,
        exports: Path | None = None,
    ):
        self.session, self.folder = session, folder
        self.gui = session.client.gui
        self.harmless = session.queue.errors.harmless
        self.frusta = Frusta(session, lambda view: self.photographs.enter(view))
        self.path = RecordedPath(session.around, folder)
        self._wants_snapshot = False
        session.on_finest = self._keep_snapshot
        self.gui.add_html(f"<style>{STYLE.read_text(encoding='utf-8')}</style>")
        # viser's panel cannot begin folded, and would cover half of a phone.
        phone = session.client.camera.image_width < PHONE * session.client.camera.image_height
        with self.gui.add_folder("Controls", expand_by_default=False) if phone else nullcontext():
            self.gui.add_markdown(MOVES_BY_TOUCH if phone else MOVES)
            self.status = self.gui.add_markdown("")
            session.on_picture = self._tell
            if training is not None:
                TrainingPanel(session, training)
            self._add_view(min(max(float(round(math.degrees(fov))), LEAST_DEGREES), MOST_DEGREES))
            self.photographs = PhotographPanel(session, self.frusta)
            PathPanel(session, self.path, self.frusta)
            self._add_crop()
            if exports is not None:
                ExportPanel(session, exports)

    def _add_view(self, degrees: float) -> None:
        channel = self.gui.add_dropdown("Shown", tuple(CHANNELS), initial_value=self.session.channel)
        self.scale = self.gui.add_html("", visible=False)
        self.axes = self.gui.add_markdown("Red, green, blue: along x, y, z.", visible=channel.value == NORMALS)
        fov = self.gui.add_slider("Field of view", LEAST_DEGREES, MOST_DEGREES, 1.0, degrees)
        snapshot = self.gui.add_button(SAVE, hint="Save the finest picture of this view as PNG")

        @channel.on_update
        @self.harmless
        def _(_: Any) -> None:
            self.session.channel = channel.value
            self.session.present()
            self.scale.visible, self.axes.visible = channel.value == DEPTH, channel.value == NORMALS

        @fov.on_update
        @self.harmless
        def _(_: Any) -> None:
            self.session.client.camera.fov = math.radians(fov.value)

        @snapshot.on_click
        @self.harmless
        def _(_: Any) -> None:
            self._wants_snapshot = True
            self.session.refinement.refresh()
            self.session.queue.wake()

    def _add_crop(self) -> None:
        record = self.session.photographs.record
        with self.gui.add_folder("Crop box", expand_by_default=False):
            if record.space == "ndc":
                self.gui.add_markdown(NO_CROP)
                return
            on = self.gui.add_checkbox("Show only what is in the box", False)
            sliders = []
            for axis, a, b in zip("xyz", *in_user_frame(record), strict=True):
                least, lower, upper = rounded_range(a, b)
                label = f"{axis}: {lower:g} to {upper:g}"
                sliders.append(self.gui.add_multi_slider(label, lower, upper, least, (lower, upper), min_range=least))

        whole = tuple(zip(*(slider.value for slider in sliders), strict=True))

        def update(_: Any) -> None:
            for axis, slider in zip("xyz", sliders, strict=True):
                slider.label = f"{axis}: {slider.value[0]:g} to {slider.value[1]:g}"
            lower, upper = zip(*(slider.value for slider in sliders), strict=True)
            box = CropBox.from_user(lower, upper, record.to_user)
            self.session.crop = box if on.value else None
            self.frusta.draw_box(box if on.value or (lower, upper) != whole else None)
            self.session.request_view()

        for each in (on, *sliders):
            each.on_update(self.harmless(update))

    def _tell(self, view: View, finest: bool) -> None:
        height, width = view.opacity.shape
        self.scale.content = depth_scale(view, self.session.photographs.record)
        said = f"Rendered at {width} x {height}{'' if finest else ', refining'}"
        if said != self.status.content:
            self.status.content = said

    def _keep_snapshot(self) -> None:
        picture = self.session.picture
        if not self._wants_snapshot or picture is None:
            return
        self._wants_snapshot = False
        try:
            with new_file(self.folder, "snapshot", ".png") as path:
                save_png(path, picture)
        except OSError as error:  # no click ends a training
            self.session.client.add_notification(SAVE, error_message(error), color="red")
        else:
            self.session.client.add_notification(SAVE, f"Saved as {path}", auto_close_seconds=10.0)


def in_user_frame(record: SceneRecord) -> tuple[list[float], list[float]]:
    """Return the lower and upper corner of the scene's bounding box along the user's axes (user's units)."""
    places = points_to_user(torch.cartesian_prod(*record.aabb.unbind(dim=1)).double(), record.to_user.double())
    return places.amin(dim=0).tolist(), places.amax(dim=0).tolist()


def rounded_range(lower: float, upper: float) -> tuple[float, float, float]:
    """Return a slider's step, about 1 % of a range, and the range widened to whole steps: numbers of few digits.

    >>> rounded_range(-1.234567, 2.345678)
    (0.04, -1.24, 2.36)
    """
    step = float(f"{LEAST_SHARE * (upper - lower):.0e}")
    low, high = math.floor(lower / step) * step, math.ceil(upper / step) * step
    return step, float(f"{low:.6g}"), float(f"{high:.6g}")
