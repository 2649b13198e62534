"""The panel's part for photographs: one is chosen by its picture, looked through, and compared with its render."""

import io
import threading
from typing import Any

from PIL import Image

from nerf_lightning.files.html import data_address
from nerf_lightning.viewer.client import ViewerClient
from nerf_lightning.viewer.error_log import as_plain_markdown, one_line
from nerf_lightning.viewer.frusta import Frusta

AT_ONCE = 9
QUALITY = 80
MOST_LETTERS = 40  # Letters of a name below its picture; all of it is said when it is chosen.
BEFORE, AFTER = "Previous", "Next"
MARK = "nerf-photograph"
# viser's buttons are one to a row, and a letter high. Browsers that do not know :has show them so.
STYLE = f"""<style>
div:has(> button img.{MARK}) {{ display: inline-block; box-sizing: border-box; width: 33.3%; vertical-align: top;
  margin: 0 !important; padding: 2px !important; }}
button:has(img.{MARK}) {{ height: auto !important; padding: 0; background: none; border: none; overflow: visible; }}
button:has(img.{MARK}) .mantine-Button-inner {{ flex-direction: column; height: auto; }}
button:has(img.{MARK}) .mantine-Button-section {{ width: 100%; margin: 0; }}
button:has(img.{MARK}) .mantine-Button-label {{ flex: none; width: 100%; display: block; height: 16px; font-size: 10px;
  font-weight: 400; line-height: 16px; color: #868e96; text-align: center; text-overflow: ellipsis; }}
div:has(> img.{MARK}) {{ width: 100%; height: auto; }}
img.{MARK} {{ display: block; width: 100%; height: 56px; object-fit: cover; background: #dee2e6; border-radius: 3px; }}
img.{MARK}:hover {{ outline: 2px solid #228be6; outline-offset: -2px; }}
</style>"""
# One grey pixel, in place of a photograph that is not at hand.
NO_PICTURE = "data:image/gif;base64,R0lGODlhAQABAIAAAN7i5gAAACwAAAAAAQABAAACAkQBADs="


class PhotographPanel:
    """Let one person choose a photograph, and compare it; meanwhile the cameras over the picture are hidden."""

    def __init__(self, session: ViewerClient, frusta: Frusta):
        self.session, self.frusta = session, frusta
        self.gui = session.client.gui
        self.names = session.photographs.record.view_names
        self.first = 0
        """The first of the pictures that are shown, counted among those that are found."""
        self._found = list(range(len(self.names)))
        self._pictures: list[Any] = []
        self._lock = threading.RLock()
        self.folder = self.gui.add_folder("Photographs", expand_by_default=False)
        with self.folder:
            self._add_controls()
        self._show_pictures()
        session.on_leave = self._left
        session.photographs.when_read.append(session.queue.errors.harmless(self._show_anew))

    def enter(self, view: int) -> None:
        """Look through the camera of a view."""
        there = self.session.photographs.has(view)
        self.name.content = f"Through the camera of {as_plain_markdown(self.names[view])}" + (
            "" if there else " (its photograph is not at hand)"
        )
        self.name.visible = self.leave.visible = True
        self.split.visible = there
        self.frusta.hide(True)
        self.session.enter(view)

    def _add_controls(self) -> None:
        harmless = self.session.queue.errors.harmless
        self.gui.add_html(STYLE)
        visible = self.gui.add_checkbox("Show cameras", False, hint="Those may be clicked, too")
        self.name = self.gui.add_markdown("", visible=False)
        self.split = self.gui.add_slider(
            "Photograph | render", 0.0, 1.0, 0.01, self.session.split, visible=False, hint="Left is the photograph"
        )
        self.leave = self.gui.add_button("Leave", visible=False)
        many = len(self.names) > AT_ONCE
        self.find = self.gui.add_text("Find", "", visible=many, hint="A part of a photograph's name")
        self.turn = self.gui.add_button_group("Pictures", (BEFORE, AFTER), visible=many)
        visible.on_update(harmless(lambda _: self.frusta.show(visible.value)))
        self.split.on_update(harmless(self._compare))
        self.leave.on_click(harmless(lambda _: self.session.leave()))
        self.find.on_update(harmless(self._search))
        self.turn.on_click(harmless(self._turn))

    def _compare(self, _: Any) -> None:
        self.session.split = self.split.value
        self.session.present()

    def _search(self, _: Any) -> None:
        with self._lock:
            part = self.find.value.lower()
            self._found = [view for view, name in enumerate(self.names) if part in name.lower()]
            self.first = 0
            self._show_pictures()

    def _turn(self, _: Any) -> None:
        with self._lock:
            after = self.first + (AT_ONCE if self.turn.value == AFTER else -AT_ONCE)
            if 0 <= after < len(self._found):
                self.first = after
                self._show_pictures()

    def _show_anew(self) -> None:
        with self._lock:
            self._show_pictures()
            self.frusta.has_cameras = False
            self.frusta.show(self.frusta.cameras.visible)

    def _show_pictures(self) -> None:
        for handle in self._pictures:
            handle.remove()
        shown = self._found[self.first : self.first + AT_ONCE]
        with self.folder:
            self._pictures = [self._picture(view) for view in shown]
        last = self.first + len(shown)
        self.turn.label = f"{self.first + 1}-{last} of {len(self._found)}" if shown else "None found"

    def _picture(self, view: int) -> Any:
        button = self.gui.add_button(one_line(self.names[view], MOST_LETTERS))
        button._icon_html = f'<img class="{MARK}" alt="" src="{self._address(view)}">'
        button.on_click(self.session.queue.errors.harmless(lambda _: self.enter(view)))
        return button

    def _address(self, view: int) -> str:
        """Return a small photograph as an address that holds it."""
        thumbnail = self.session.photographs.thumbnail(view)
        if thumbnail is None:
            return NO_PICTURE
        file = io.BytesIO()
        Image.fromarray(thumbnail.numpy()).save(file, format="JPEG", quality=QUALITY)
        return data_address("image/jpeg", file.getvalue())

    def _left(self) -> None:
        self.name.visible = self.leave.visible = self.split.visible = False
        self.frusta.hide(False)
