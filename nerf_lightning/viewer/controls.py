"""The panel of the page: what is shown, the crop box, photographs, the camera path, snapshots."""

import math
from pathlib import Path
from typing import Any, TypeVar

import torch

from nerf_lightning.nerf.geometry.clipping import CropBox
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.viewer import limits
from nerf_lightning.viewer.channels import CHANNELS
from nerf_lightning.viewer.client import ViewerClient
from nerf_lightning.viewer.frusta import Frusta
from nerf_lightning.viewer.path_panel import PathPanel
from nerf_lightning.viewer.plain_text import as_plain_markdown
from nerf_lightning.viewer.recorded_path import RecordedPath, free_name, not_saved
from nerf_lightning.visualization.pictures import save_png

Number = TypeVar("Number", int, float)

AXES = ("x", "y", "z")
LEAST_DEGREES, MOST_DEGREES = 10.0, 120.0
# The crop box keeps this share of the scene's box along each axis.
LEAST_SHARE = 0.01
NO_CROP = "Not here: a forward-facing capture has no box of its own. `nerf render crop=...` cuts its films."


class Controls:
    """The panel of one person.

    Args:
        session: theirs.
        folder: where snapshots and camera paths are written.
    """

    def __init__(self, session: ViewerClient, folder: Path):
        self.session, self.folder = session, folder
        self.gui = session.client.gui
        self.harmless = session.queue.complaints.harmless
        self.frusta = Frusta(session, self._enter)
        self.path = RecordedPath(session.around, folder)
        self._wants_snapshot = False
        session.on_finest, session.on_leave = self._keep_snapshot, self._left
        self._add_view()
        self._add_photographs()
        PathPanel(session, self.path, self.frusta.hide)
        self._add_crop()

    def _add_view(self) -> None:
        channel = self.gui.add_dropdown("Show", tuple(CHANNELS), initial_value=self.session.channel)
        degrees = round(math.degrees(self.session.client.camera.fov))
        shown = within(float(degrees), LEAST_DEGREES, MOST_DEGREES)
        fov = self.gui.add_slider("Field of view", LEAST_DEGREES, MOST_DEGREES, 1.0, shown)
        snapshot = self.gui.add_button("Snapshot", hint="Save the finest picture of this view as PNG")

        @channel.on_update
        @self.harmless
        def _(_: Any) -> None:
            if channel.value in CHANNELS:
                self.session.channel = channel.value
                self.session.present()

        @fov.on_update
        @self.harmless
        def _(_: Any) -> None:
            self.session.client.camera.fov = math.radians(within(fov.value, LEAST_DEGREES, MOST_DEGREES))

        @snapshot.on_click
        @self.harmless
        def _(_: Any) -> None:
            self._wants_snapshot = True
            self.session.refinement.refresh()
            self.session.queue.wake()

    def _add_photographs(self) -> None:
        names = self.session.photographs.record.view_names
        with self.gui.add_folder("Photographs"):
            visible = self.gui.add_checkbox("Show cameras", False)
            number = self.gui.add_slider("View", 0, max(1, len(names) - 1), 1, 0)
            enter = self.gui.add_button("Look through it", hint="Or click a camera in the scene")
            self._name = self.gui.add_markdown("", visible=False)
            self._split = self.gui.add_slider(
                "Photograph | render", 0.0, 1.0, 0.01, self.session.split, visible=False, hint="Left is the photograph"
            )
            self._leave = self.gui.add_button("Leave", visible=False)

        @visible.on_update
        @self.harmless
        def _(_: Any) -> None:
            self.frusta.show(visible.value)

        @enter.on_click
        @self.harmless
        def _(_: Any) -> None:
            self._enter(within(number.value, 0, len(names) - 1))

        @self._split.on_update
        @self.harmless
        def _(_: Any) -> None:
            self.session.split = within(self._split.value, 0.0, 1.0)
            self.session.present()

        @self._leave.on_click
        @self.harmless
        def _(_: Any) -> None:
            self.session.leave()

    def _enter(self, view: int) -> None:
        photographs = self.session.photographs
        there = photographs.has(view)
        self._name.content = f"Through the camera of {as_plain_markdown(photographs.record.view_names[view])}" + (
            "" if there else " (its photograph is not at hand)"
        )
        self._name.visible = self._leave.visible = True
        self._split.visible = there
        self.frusta.hide(True)
        self.session.enter(view)

    def _left(self) -> None:
        self._name.visible = self._leave.visible = self._split.visible = False
        self.frusta.hide(False)

    def _add_crop(self) -> None:
        record = self.session.photographs.record
        with self.gui.add_folder("Crop box", expand_by_default=False):
            if record.space == "ndc":
                self.gui.add_markdown(NO_CROP)
                return
            low, high = in_user_frame(record)
            on = self.gui.add_checkbox("Show only what is in the box", False)
            sliders = [
                self.gui.add_multi_slider(axis, a, b, LEAST_SHARE * (b - a), (a, b), min_range=LEAST_SHARE * (b - a))
                for axis, a, b in zip(AXES, low, high, strict=True)
            ]

        def update(_: Any) -> None:
            ends = (ends_within(slider.value, a, b) for slider, a, b in zip(sliders, low, high, strict=True))
            lower, upper = zip(*ends, strict=True)
            self.session.crop = CropBox.from_user(lower, upper, record.to_user) if on.value else None
            self.frusta.draw_box(self.session.crop)
            self.session.look()

        for each in (on, *sliders):
            each.on_update(self.harmless(update))

    def _keep_snapshot(self) -> None:
        picture = self.session.latest()
        if not self._wants_snapshot or picture is None:
            return
        self._wants_snapshot = False
        try:
            with free_name(self.folder, "snapshot", ".png", limits.MOST_SNAPSHOTS) as path:
                save_png(path, picture)
        except OSError as error:  # nothing that is clicked ends a training
            self.session.client.add_notification("Snapshot", not_saved(error), color="red")
        else:
            self.session.client.add_notification("Snapshot", f"Saved as {path}", auto_close_seconds=10.0)


def within(value: Number, least: Number, most: Number) -> Number:
    """Return the nearest number in a range: a browser may send what its slider does not have.

    >>> within(7, 0, 5)
    5
    """
    return min(max(value, least), most)


def ends_within(ends: tuple[float, ...], least: float, most: float) -> tuple[float, float]:
    """Return the two ends of an interval within a range, the second one greater.

    >>> ends_within((9.0, -9.0), 0.0, 4.0)
    (3.96, 4.0)
    """
    lower, upper = ends
    gap = LEAST_SHARE * (most - least)
    lower = within(lower, least, most - gap)
    return lower, within(upper, lower + gap, most)


def in_user_frame(record: SceneRecord) -> tuple[list[float], list[float]]:
    """Return the lower and the upper corner of the box along the user's axes that holds the scene's (user's units)."""
    corners = torch.cartesian_prod(*record.aabb.unbind(dim=1)).double()
    places = corners @ record.to_user[:3, :3].double().mT + record.to_user[:3, 3]
    return places.amin(dim=0).tolist(), places.amax(dim=0).tolist()
