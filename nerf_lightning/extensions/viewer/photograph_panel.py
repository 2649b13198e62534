"""The panel's section for photographs: choose one by name, look through its camera, and compare it with its render."""

from collections import Counter
from typing import Any

from nerf_lightning.extensions.viewer.client import ViewerClient
from nerf_lightning.extensions.viewer.frusta import Frusta
from nerf_lightning.messages.escaping import as_code, for_terminal

NONE = "none"
MOST_LETTERS = 60  # Characters of a name in the list; the full name is shown when it is chosen.


class PhotographPanel:
    """Let one user choose a photograph, and compare it; the cameras over the picture are hidden meanwhile."""

    def __init__(self, session: ViewerClient, frusta: Frusta):
        self.session, self.frusta = session, frusta
        self.names = session.photographs.record.view_names
        gui, harmless = session.client.gui, session.queue.errors.harmless
        short = [for_terminal(name, MOST_LETTERS) for name in self.names]
        # viser knows options by their text, so names that are shortened alike get a number.
        count = Counter([NONE, *short])
        labels = [f"{view}: {name}" if count[name] > 1 else name for view, name in enumerate(short)]
        with gui.add_folder("Photographs", expand_by_default=False):
            visible = gui.add_checkbox("Show cameras", False, hint="These can be clicked, too")
            self.choice = gui.add_dropdown("Photograph", (NONE, *labels), initial_value=NONE)
            self.name = gui.add_markdown("", visible=False)
            self.split = gui.add_slider("Photograph | Render", 0.0, 1.0, 0.01, session.split, visible=False)
            self.leave = gui.add_button("Leave photograph", visible=False)
        visible.on_update(harmless(lambda _: self.frusta.show(visible.value)))
        self.choice.on_update(harmless(self._choose))
        self.split.on_update(harmless(self._compare))
        self.leave.on_click(harmless(lambda _: session.leave()))
        session.on_leave = self._on_leave
        session.photographs.when_read.append(harmless(self._show_anew))

    def enter(self, view: int) -> None:
        """Look through the camera of a view."""
        there = self.session.photographs.has(view)
        self.name.content = f"Camera of {as_code(self.names[view])}" + (
            "" if there else " (its photograph is not available)"
        )
        self.choice.value = self.choice.options[view + 1]
        self.name.visible = self.leave.visible = True
        self.split.visible = there
        self.frusta.hide(True)
        self.session.enter(view)

    def _choose(self, event: Any) -> None:
        if event.client is None:  # set by the program
            return
        if self.choice.value == NONE:
            self.session.leave()
        else:
            self.enter(self.choice.options.index(self.choice.value) - 1)

    def _compare(self, _: Any) -> None:
        self.session.split = self.split.value
        self.session.present()

    def _show_anew(self) -> None:
        self.frusta.has_cameras = False
        self.frusta.show(self.frusta.cameras.visible)

    def _on_leave(self) -> None:
        self.choice.value = NONE
        self.name.visible = self.leave.visible = self.split.visible = False
        self.frusta.hide(False)
