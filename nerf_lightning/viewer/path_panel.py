"""The panel's part for a camera path: its keyframes, its time line, and its files."""

import threading
from collections.abc import Callable
from typing import Any

import torch

from nerf_lightning.messages.errors import InputError
from nerf_lightning.video.paths.keyframes import Keyframe
from nerf_lightning.viewer import limits
from nerf_lightning.viewer.camera_state import fov_held_by
from nerf_lightning.viewer.client import ViewerClient
from nerf_lightning.viewer.path_drawing import PathDrawing
from nerf_lightning.viewer.path_player import PathPlayer
from nerf_lightning.viewer.plain_text import as_plain_markdown
from nerf_lightning.viewer.recorded_path import (
    LEAST_SECONDS,
    USUAL_SECONDS,
    RecordedPath,
    keyframe_in_user_frame,
    not_saved,
)

# Letters of a message: it names a file, and shall be whole.
MOST_SAID = 5000
HERE, EARLIER, LATER, DELETE = "To this view", "Earlier", "Later", "Delete"
PLAY, STOP = "Play", "Stop"
NO_FILES, NOTHING = "none yet", "No keyframes yet."
# Numbers under the time line, before they run into each other.
MOST_MARKS = 9


class PathPanel:
    """Let one person make a path, look at it and save it.

    Args:
        session: theirs.
        path: what they make.
        hide: called with whether all that is drawn over the picture shall be hidden.
    """

    def __init__(self, session: ViewerClient, path: RecordedPath, hide: Callable[[bool], None]):
        self.session, self.path, self.hide = session, path, hide
        self.gui = session.client.gui
        self.drawing = PathDrawing(session)
        self.player = PathPlayer(session, path, self._show_time, self._ended)
        self.chosen = 0
        """The keyframe that the buttons change, from 0."""
        self._lock = threading.RLock()
        self._sets = False
        self.folder = self.gui.add_folder("Camera path", expand_by_default=False)
        with self.folder:
            self._add_controls()
        self._refresh()

    def _add_controls(self) -> None:
        add = self.gui.add_button("Add keyframe", hint="The camera as it is now, after the chosen keyframe")
        self.number = self.gui.add_dropdown("Keyframe", ("1",), initial_value="1", visible=False)
        self.leg = self.gui.add_number(
            "Seconds to it",
            USUAL_SECONDS,
            min=LEAST_SECONDS,
            max=limits.MOST_SECONDS_BETWEEN,
            step=0.1,
            visible=False,
            hint="From the keyframe before",
        )
        self.change = self.gui.add_button_group("Change it", (HERE, DELETE), visible=False)
        self.order = self.gui.add_button_group("Move it", (EARLIER, LATER), visible=False)
        self.line = self._time_line(1.0, 0.0)
        self.play = self.gui.add_button(PLAY, visible=False, hint="Go along the path in this page")
        self.save = self.gui.add_button("Save as yaml", visible=False)
        self.file = self.gui.add_dropdown(
            "Saved", (NO_FILES,), hint=f"The keyframe files in {self.path.folder}: put others there to load them"
        )
        load = self.gui.add_button("Load", hint="In place of the keyframes that are here")
        self.said = self.gui.add_markdown(NOTHING)
        add.on_click(self._act(lambda _: self._add()))
        self.number.on_update(self._act(self._choose))
        self.leg.on_update(self._act(self._set_leg))
        self.change.on_click(self._act(self._change))
        self.order.on_click(self._act(self._move))
        self.play.on_click(self._act(lambda _: self._play()))
        self.save.on_click(self._act(lambda _: self._save()))
        load.on_click(self._act(lambda _: self._load()))

    def _act(self, act: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return an act for viser to call: one after the other, and never for what the program has set itself."""

        def careful(event: Any) -> None:
            with self._lock:
                if self._sets:
                    return
                try:
                    act(event)
                except InputError as error:
                    self._say(str(error))
                except OSError as error:
                    self._say(not_saved(error))

        return self.session.queue.complaints.harmless(careful)

    def _add(self) -> None:
        self.path.insert(self.chosen + 1 if self.path.keyframes else 0, self._view())
        self.chosen = min(self.chosen + 1, len(self.path.keyframes) - 1)
        self._refresh()

    def _view(self) -> Keyframe:
        camera = self.session.client.camera
        position, look_at, up = map(torch.tensor, (camera.position, camera.look_at, camera.up_direction))
        fov = fov_held_by(float(camera.fov), self.path.shape, camera.aspect)
        return keyframe_in_user_frame(position, look_at, up, fov, self.session.photographs.record)

    def _choose(self, _: Any) -> None:
        given = self.number.value
        if given in self._numbers():
            self.chosen = int(given) - 1
            self._refresh()
            self.session.go(self.path.poses()[self.chosen], self.path.fovs()[self.chosen])

    def _set_leg(self, _: Any) -> None:
        if self.chosen:
            self.path.set_leg(self.chosen, float(self.leg.value))
            self._refresh()

    def _change(self, _: Any) -> None:
        if not self.path.keyframes:
            return
        if self.change.value == HERE:
            self.path.change(self.chosen, self._view())
        elif self.change.value == DELETE:
            self.path.remove(self.chosen)
            self.chosen = max(0, min(self.chosen, len(self.path.keyframes) - 1))
        self._refresh()

    def _move(self, _: Any) -> None:
        by = {EARLIER: -1, LATER: 1}.get(self.order.value, 0)
        if self.path.keyframes and by:
            self.chosen = self.path.move(self.chosen, by)
            self._refresh()

    def _scrub(self, _: Any) -> None:
        self.player.stop()
        self.player.show(float(self.line.value))

    def _play(self) -> None:
        if self.player.is_playing:
            self.player.stop()
        elif len(self.path.keyframes) > 1:
            self.session.leave()
            self.hide(True)
            self._set(self.play, label=STOP)
            self.player.play(float(self.line.value))

    def _show_time(self, seconds: float) -> None:
        with self._lock:
            self._set(self.line, value=round(min(seconds, self.line.max), 2))

    def _ended(self) -> None:
        with self._lock:
            self._set(self.play, label=PLAY)
            self.hide(False)

    def _save(self) -> None:
        path = self.path.save()
        self._list_files()
        command = as_plain_markdown(f"path=keyframes path.file={path}", MOST_SAID)
        self.said.content = f"Saved. To film it, add to nerf render: {command}"

    def _load(self) -> None:
        self._list_files()
        if self.file.value == NO_FILES:
            self._say(f"There is no keyframe file in {self.path.folder}.")
            return
        self.player.stop()
        self.path.load(self.file.value)
        self.chosen = 0
        self._refresh()

    def _list_files(self) -> None:
        names = tuple(self.path.files()) or (NO_FILES,)
        if names != tuple(self.file.options):
            kept = self.file.value if self.file.value in names else names[0]
            self._set(self.file, options=names, value=kept)

    def _numbers(self) -> tuple[str, ...]:
        return tuple(str(number + 1) for number in range(len(self.path.keyframes)))

    def _refresh(self) -> None:
        """Show the path as it is now."""
        self._list_files()
        count, numbers = len(self.path.keyframes), self._numbers()
        for each in (self.number, self.change):
            each.visible = count > 0
        for each in (self.order, self.play, self.save):
            each.visible = count > 1
        self.leg.visible = self.chosen > 0
        if count:
            self._set(self.number, options=numbers, value=numbers[self.chosen])
            self._set(self.leg, value=max(LEAST_SECONDS, round(self.path.legs[self.chosen], 2)))
        if count > 1:
            self._lay_time_line()
        else:
            self.line.visible = False
        total = f"{count} keyframe{'s' * (count > 1)}, {self.path.seconds:.1f} s"
        self._say(total if count else NOTHING, plain=True)
        self.drawing.draw(self.path)

    def _lay_time_line(self) -> None:
        end = round(self.path.seconds, 2)
        every = -(-len(self.path.keyframes) // MOST_MARKS)
        marks = [(round(time, 2), str(number + 1)) for number, time in enumerate(self.path.times)][::every]
        at, before = round(self.path.times[self.chosen], 2), self.line
        with self.folder:  # viser's marks are fixed, so it is another one
            self.line = self._time_line(end, min(at, end), tuple(marks), float(before.order))
        before.remove()

    def _time_line(self, end: float, at: float, marks: Any = None, order: float | None = None) -> Any:
        line = self.gui.add_slider("Time", 0.0, end, 0.01, at, marks=marks, order=order, visible=marks is not None)
        line.on_update(self._act(self._scrub))
        return line

    def _set(self, control: Any, **values: Any) -> None:
        self._sets = True
        try:
            for name, value in values.items():
                setattr(control, name, value)
        finally:
            self._sets = False

    def _say(self, text: str, plain: bool = False) -> None:
        self.said.content = text if plain else as_plain_markdown(text, MOST_SAID)
