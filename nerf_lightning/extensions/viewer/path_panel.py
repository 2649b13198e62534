"""The panel's section for a camera path: its keyframes, its timeline, and its files."""

import threading
import time
from collections.abc import Callable
from typing import Any

import torch

from nerf_lightning.extensions.viewer.camera_state import fov_held_by
from nerf_lightning.extensions.viewer.client import ViewerClient
from nerf_lightning.extensions.viewer.frusta import Frusta
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import as_code
from nerf_lightning.video.paths.recorded_path import USUAL_SECONDS, RecordedPath, error_message, keyframe_of

LEAST_SECONDS, MOST_SECONDS = 0.1, 3600.0
PLAY, STOP = "Play", "Pause"
NO_FILES, NOTHING = "none yet", "No keyframes yet."
PER_SECOND = 12  # Views per second while a path is played: faster than coarse pictures arrive would only queue.


class PathPanel:
    """Let one user create, preview and save a path; `frusta` draws it."""

    def __init__(self, session: ViewerClient, path: RecordedPath, frusta: Frusta):
        self.session, self.path, self.frusta = session, path, frusta
        self.chosen = 0
        """The keyframe that the buttons change, from 0."""
        self._lock = threading.RLock()
        self._playing: threading.Event | None = None
        """Set to stop playing; None: nothing is played."""
        gui, seconds = session.client.gui, {"min": LEAST_SECONDS, "max": MOST_SECONDS, "step": 0.1}
        with gui.add_folder("Camera path", expand_by_default=False):
            add = gui.add_button("Add keyframe", hint="Add the current camera after the chosen keyframe")
            self.number = gui.add_dropdown("Keyframe", ("1",), initial_value="1", visible=False)
            self.leg = gui.add_number("Transition (s)", USUAL_SECONDS, **seconds, visible=False)
            self.delete = gui.add_button("Delete keyframe", visible=False)
            self.line = gui.add_slider("Time", 0.0, 1.0, 0.01, 0.0, visible=False)
            self.play = gui.add_button(PLAY, visible=False, hint="Play the path in this page")
            self.save = gui.add_button("Save path", visible=False)
            hint = f"The keyframe files in {self.path.folder}: put others there to load them"
            self.file = gui.add_dropdown("Saved paths", (NO_FILES,), hint=hint)
            self.load = gui.add_button("Load path", hint="Replace the current keyframes")
            self.said = gui.add_markdown(NOTHING)
        add.on_click(self._act(self._add))
        self.number.on_update(self._act(self._choose))
        self.leg.on_update(self._act(self._set_leg))
        self.delete.on_click(self._act(self._delete))
        self.line.on_update(self._act(self._scrub))
        self.play.on_click(self._act(self._play))
        self.save.on_click(self._act(self._save))
        self.load.on_click(self._act(self._load))
        self._refresh()

    def _act(self, act: Callable[[], None]) -> Callable[[Any], None]:
        """Wrap a callback for viser: calls are serialized, and changes by the program itself are ignored."""

        def careful(event: Any) -> None:
            if event.client is None:
                return
            with self._lock:
                try:
                    act()
                except (InputError, OSError) as error:
                    self.said.content = as_code(error_message(error))

        return self.session.queue.errors.harmless(careful)

    def _add(self) -> None:
        number = self.chosen + 1 if self.path.keyframes else 0
        camera = self.session.client.camera
        position, look_at, up = map(torch.tensor, (camera.position, camera.look_at, camera.up_direction))
        fov = fov_held_by(float(camera.fov), self.path.shape, camera.aspect)
        self.path.insert(number, keyframe_of(position, look_at, up, fov, self.path.around))
        self.chosen = number
        self._refresh()

    def _choose(self) -> None:
        self.chosen = int(self.number.value) - 1
        self._refresh()
        self.session.go(*self.path.views()[self.chosen])

    def _set_leg(self) -> None:
        self.path.legs[self.chosen] = min(max(float(self.leg.value), LEAST_SECONDS), MOST_SECONDS)
        self._refresh()

    def _delete(self) -> None:
        self.path.remove(self.chosen)
        self.chosen = max(0, min(self.chosen, len(self.path.keyframes) - 1))
        self._refresh()

    def _scrub(self) -> None:
        self._stop()
        if (curve := self.path.curve()) is not None:
            self.session.go(*self.path.view_at(curve, float(self.line.value)))

    def _play(self) -> None:
        curve, end = self.path.curve(), self.path.times[-1]
        if self._playing is not None or curve is None:
            self._stop()
            return
        begin = self.line.value if self.line.value < end - 1 / PER_SECOND else 0.0
        self._playing = stopped = threading.Event()
        self.session.leave()
        self.frusta.hide(True)
        self.play.label = STOP

        def go() -> None:
            began, seconds = time.monotonic(), begin
            while seconds < end and self.session.is_here() and not stopped.wait(1 / PER_SECOND):
                seconds = min(begin + time.monotonic() - began, end)
                self.session.go(*self.path.view_at(curve, seconds))
                self.line.value = round(min(seconds, self.line.max), 2)
            if not stopped.is_set():
                self._stop()

        threading.Thread(target=self.session.queue.errors.harmless(go), daemon=True).start()

    def _stop(self) -> None:
        """Stop playing; the camera stays where it is."""
        with self._lock:
            if self._playing is not None:
                self._playing.set()
                self._playing = None
                self.session.level()
                self.play.label = PLAY
                self.frusta.hide(False)

    def _save(self) -> None:
        command = as_code(f"path=keyframes path.file={self.path.save()}")
        self._list_files()
        self.said.content = f"Saved. To film it, add to nerf render: {command}"

    def _load(self) -> None:
        self._list_files()
        if self.file.value == NO_FILES:
            raise InputError(f"There is no keyframe file in {self.path.folder}.")
        self._stop()
        self.path.load(self.file.value)
        self.chosen = 0
        self._refresh()

    def _list_files(self) -> None:
        names = tuple(self.path.files()) or (NO_FILES,)
        self.load.disabled = names == (NO_FILES,)
        if names != tuple(self.file.options):
            kept = self.file.value if self.file.value in names else names[0]
            self.file.options, self.file.value = names, kept

    def _refresh(self) -> None:
        """Show the current path."""
        self._list_files()
        count, times = len(self.path.keyframes), self.path.times
        self.number.visible = self.delete.visible = count > 0
        self.line.visible = self.play.visible = self.save.visible = count > 1
        self.leg.visible = self.chosen > 0
        self.said.content = NOTHING
        if count:
            self.number.options, self.number.value = tuple(map(str, range(1, count + 1))), str(self.chosen + 1)
            self.leg.value = round(self.path.legs[self.chosen], 2)
            self.line.max = max(0.01, round(times[-1], 2))
            self.line.value = min(round(times[self.chosen], 2), self.line.max)
            self.said.content = f"{count} keyframe{'s' * (count > 1)}, {times[-1]:.1f} s"
        self.frusta.draw_path(self.path)
