"""A film that is rendered beside what people look at: a frame whenever it has its turn."""

import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch

from nerf_lightning.files.made_folders import make_new_folder, remove_new_folder
from nerf_lightning.messages.errors import InputError
from nerf_lightning.video.film import film_steps, films_of
from nerf_lightning.video.paths.keyframe_path import KeyframePath
from nerf_lightning.video.settings import FilmSettings
from nerf_lightning.video.shots import Subject
from nerf_lightning.viewer import limits
from nerf_lightning.viewer.recorded_path import RecordedPath
from nerf_lightning.viewer.render_queue import RenderQueue
from nerf_lightning.viewer.renderer import SlicedRenderer

# What the queue knows the film by: clients count from 0.
FILM = -1
FAILED = "The film could not be rendered: what went wrong stands where nerf was started."


class FilmJob:
    """Render the film of a path, and make one file of it.

    Args:
        folder: a new folder of its own, which goes where the film fails or is stopped.
        path: the path; it is written beside the film.
        renderer: what renders.
        width: of the film, in pixels.
        rate: frames per second.
        settings: what is shown.
        on_change: called whenever it has got further, from the thread that did.

    Raises:
        InputError: the path cannot be filmed so.
        OSError: the folder cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        path: RecordedPath,
        renderer: SlicedRenderer,
        width: int,
        rate: int,
        settings: FilmSettings,
        on_change: Callable[["FilmJob"], None],
    ):
        self.folder, self.on_change = folder, on_change
        self.served = 0.0
        self.done, self.total = 0, 1
        self.result: Path | None = None
        self.failure: str | None = None
        """Why there will be no film."""
        path.write(folder / "camera_path.yaml")
        film = KeyframePath(str(folder / "camera_path.yaml"), width=width, fps=rate)
        subject = Subject(renderer.model, renderer.scene, renderer.background)
        shown = replace(settings, outputs=("rgb",))
        self._steps = film_steps([subject], film, renderer.tile_points, folder, shown, shows_encoding=False)
        self._encodes = False
        self._stops = False

    @property
    def is_over(self) -> bool:
        """Whether there is a film, or will be none."""
        return self.result is not None or self.failure is not None

    @property
    def is_moving(self) -> bool:
        """Never: whoever moves a camera waits for less."""
        return False

    def refresh(self) -> None:
        """Do nothing: frames that are there stay."""

    def stop(self) -> None:
        """Make no film; the frame that is being rendered ends first."""
        self._stops = True

    def give_up(self) -> None:
        """Make no film: a frame could not be rendered."""
        self._fail(FAILED)

    def work(self, renderer: SlicedRenderer) -> bool:
        """Render a frame; return False where nothing is left to do here."""
        if self.is_over or self._encodes:
            return False
        if self._stops:
            self._fail("The film was stopped.")
            return False
        try:
            with torch.no_grad():
                self.done, self.total = next(self._steps)
        except (InputError, OSError) as error:
            self._fail(str(error))
            return False
        if self.done == self.total:
            self._encodes = True
            threading.Thread(target=self._encode, daemon=True).start()
        self.on_change(self)
        return True

    def _encode(self) -> None:
        """Make one file of the frames, beside the thread that renders."""
        try:
            self.result = films_of(self._steps)[0]
        except (InputError, OSError) as error:
            self._fail(str(error))
        else:
            self.on_change(self)

    def _fail(self, why: str) -> None:
        self.failure = why
        self._steps.close()
        remove_new_folder(self.folder)
        self.on_change(self)


def end_film(queue: RenderQueue) -> None:
    """Stop the film that is being made, if one is; one whose frames are all there becomes a video."""
    job = queue.turn_of(FILM)
    if isinstance(job, FilmJob):
        job.stop()
        job.work(queue.renderer)


def new_folder(folder: Path) -> Path:
    """Make the folder of a film, with the first number that is free.

    Raises:
        OSError: there are too many, or it cannot be made.
    """
    for number in range(1, limits.MOST_FILMS + 1):
        with suppress(FileExistsError):
            made = folder / f"film_{number:03d}"
            make_new_folder(made)
            return made
    raise OSError(f"{folder} holds {limits.MOST_FILMS} films, the most that the page makes")
