"""A film of the camera path, rendered beside what people look at: a frame whenever it has its turn."""

import threading
from collections.abc import Callable
from pathlib import Path

import torch

from nerf_lightning.files.made_folders import make_new_folder, remove_new_folder
from nerf_lightning.messages.errors import InputError
from nerf_lightning.video.film import FilmSteps, film_steps, films_of
from nerf_lightning.video.paths.keyframe_path import KeyframePath
from nerf_lightning.video.paths.keyframes import write_keyframes
from nerf_lightning.video.settings import FilmSettings
from nerf_lightning.video.shots import Subject
from nerf_lightning.viewer.client import ViewerClient
from nerf_lightning.viewer.error_log import as_plain_markdown
from nerf_lightning.viewer.recorded_path import RecordedPath, first_free, told
from nerf_lightning.viewer.render_queue import RenderQueue
from nerf_lightning.viewer.renderer import SlicedRenderer

FILM = -1  # What the queue knows the film by: clients count from 0.
LEAST_WIDTH, USUAL_WIDTH, MOST_WIDTH = 32, 640, 1920
USUAL_RATE, MOST_RATE = 30, 60


class FilmPanel:
    """The panel's part that lets one person film the camera path; in the queue it stands for the film in the making.

    It goes on when they leave. `why_not` returns why no film can be made now (one sentence), or None.
    """

    is_moving = False  # whoever moves a camera waits for less

    def __init__(self, session: ViewerClient, path: RecordedPath, why_not: Callable[[], str | None]):
        self.session, self.path, self.why_not = session, path, why_not
        self.served, self.stops = 0.0, False
        self.result: Path | None = None
        self._folder: Path | None = None
        self._steps: FilmSteps | None = None
        self._encodes = False
        gui, harmless = session.client.gui, session.queue.errors.harmless
        width = max(LEAST_WIDTH, min(session.around.width, USUAL_WIDTH))
        with gui.add_folder("Film", expand_by_default=False):
            self.width = gui.add_number("Width", width, min=LEAST_WIDTH, max=MOST_WIDTH, step=1, hint="In pixels")
            self.rate = gui.add_number("Frame rate", USUAL_RATE, min=1, max=MOST_RATE, step=1, hint="Per second")
            self.render = gui.add_button("Render film", hint="Along the camera path, with the crop box if it is on")
            self.halt = gui.add_button("Stop the film", visible=False, color="gray")
            self.bar = gui.add_progress_bar(0.0, visible=False)
            self.said = gui.add_markdown("The camera path becomes a video.")
            self.fetch = gui.add_button("Download", visible=False)
        self.render.on_click(harmless(lambda _: self._start()))
        self.halt.on_click(harmless(lambda _: self.stop()))
        self.fetch.on_click(harmless(lambda _: self._send()))

    def refresh(self) -> None:
        """Do nothing: frames that are there stay."""

    def stop(self) -> None:
        """Make no film; the frame that is being rendered ends first."""
        self.stops = True
        self.session.queue.wake()

    def give_up(self) -> None:
        """Make no film: a frame could not be rendered."""
        self._fail(InputError("The film could not be rendered: the terminal of nerf shows the error."))

    def work(self, renderer: SlicedRenderer) -> bool:
        """Render a frame; return False where nothing is left to do here."""
        if self._encodes or self._steps is None:
            return False
        try:
            if self.stops:
                raise InputError("The film was stopped.")
            with torch.no_grad():
                done, total = next(self._steps)
        except (InputError, OSError) as error:
            self._fail(error)
            return False
        self._encodes = done == total
        self._show("Making the video ..." if self._encodes else f"Frame {done} of {total}", 100.0 * done / total)
        if self._encodes:  # beside the thread that renders
            encode = self.session.queue.errors.harmless(self._encode)
            threading.Thread(target=encode, args=(self._steps,), daemon=True).start()
        return True

    def _start(self) -> None:
        queue, reason = self.session.queue, self.why_not()
        if len(self.path.keyframes) < 2:
            reason = "Add two keyframes or more to the camera path first."
        elif queue.turn_of(FILM) is not None:
            reason = "Another film is being made. Only one is made at a time."
        if reason is not None:
            self.said.content = reason
            return
        self._folder, self._steps = None, None  # those of the film before stay
        try:
            self._folder = first_free(self.path.folder, "film", "", make_new_folder)
            self._steps = self._film(self._folder, queue.renderer)
        except (InputError, OSError) as error:
            self._fail(error)
            return
        self.result, self.stops, self._encodes = None, False, False
        self._show("The film begins.")
        queue.add(FILM, self)

    def _film(self, folder: Path, renderer: SlicedRenderer) -> FilmSteps:
        file = folder / "camera_path.yaml"
        write_keyframes(file, self.path.timed())
        width = min(max(LEAST_WIDTH, int(self.width.value)), MOST_WIDTH)
        path = KeyframePath(str(file), width=width, fps=min(max(1, int(self.rate.value)), MOST_RATE))
        subject = Subject(renderer.model, renderer.scene, renderer.background)
        settings = FilmSettings(outputs=("rgb",), crop=self.session.crop_corners)
        return film_steps([subject], path, renderer.tile_points, folder, settings, shows_encoding=False)

    def _encode(self, steps: FilmSteps) -> None:
        try:
            self.result = films_of(steps)[0]
        except (InputError, OSError) as error:
            self._fail(error)
        else:
            self._show(f"The film is at {as_plain_markdown(str(self.result))}", is_over=True)

    def _fail(self, error: Exception) -> None:
        if self._steps is not None:
            self._steps.close()
        if self._folder is not None:
            remove_new_folder(self._folder)
        self._show(as_plain_markdown(told(error)), is_over=True)

    def _show(self, text: str, percent: float = 0.0, is_over: bool = False) -> None:
        if is_over:
            self.session.queue.remove(FILM)
        if self.session.is_here():
            self.halt.visible = self.bar.visible = not is_over
            self.render.visible, self.fetch.visible = is_over, self.result is not None
            self.bar.value, self.said.content = percent, text

    def _send(self) -> None:
        if self.result is not None:
            name = f"{self.result.parent.name}{self.result.suffix}"
            self.session.client.send_file_download(name, self.result.read_bytes(), save_immediately=True)


def end_film(queue: RenderQueue) -> None:
    """Stop the film that is being made, if one is; one whose frames are all there becomes a video."""
    film = queue.turn_of(FILM)
    if isinstance(film, FilmPanel):
        film.stop()
        film.work(queue.renderer)
