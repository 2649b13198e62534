"""The panel's part for films: the camera path as a video, how far it is, and where it lies."""

from collections.abc import Callable
from pathlib import Path

from nerf_lightning.files.made_folders import remove_new_folder
from nerf_lightning.messages.errors import InputError
from nerf_lightning.video.settings import FilmSettings
from nerf_lightning.viewer import limits
from nerf_lightning.viewer.client import ViewerClient
from nerf_lightning.viewer.film_job import FILM, FilmJob, new_folder
from nerf_lightning.viewer.path_panel import MOST_SAID
from nerf_lightning.viewer.plain_text import as_plain_markdown
from nerf_lightning.viewer.ranges import within
from nerf_lightning.viewer.recorded_path import RecordedPath, not_saved

USUAL_WIDTH, USUAL_RATE = 640, 30
BUSY = "Another film is being made. Only one is made at a time."


class FilmPanel:
    """Let one person film the camera path.

    Args:
        session: theirs.
        path: what is filmed.
        folder: where films are written, each in a folder of its own.
        why_not: returns why no film can be made now (one sentence), or None.
    """

    def __init__(self, session: ViewerClient, path: RecordedPath, folder: Path, why_not: Callable[[], str | None]):
        self.session, self.path, self.folder, self.why_not = session, path, folder, why_not
        self.gui = session.client.gui
        self.job: FilmJob | None = None
        with self.gui.add_folder("Film", expand_by_default=False):
            self._add_controls()

    def _add_controls(self) -> None:
        harmless = self.session.queue.complaints.harmless
        width = within(self.session.around.width, limits.LEAST_FILM_WIDTH, USUAL_WIDTH)
        self.width = self.gui.add_number(
            "Width", width, min=limits.LEAST_FILM_WIDTH, max=limits.MOST_FILM_WIDTH, step=1, hint="In pixels"
        )
        self.rate = self.gui.add_number(
            "Frame rate", USUAL_RATE, min=1, max=limits.MOST_FILM_RATE, step=1, hint="Per second"
        )
        self.render = self.gui.add_button("Render film", hint="Along the camera path, with the crop box if it is on")
        self.halt = self.gui.add_button("Stop the film", visible=False, color="gray")
        self.bar = self.gui.add_progress_bar(0.0, visible=False)
        self.said = self.gui.add_markdown("The camera path becomes a video.")
        self.fetch = self.gui.add_button("Download", visible=False)
        self.render.on_click(harmless(lambda _: self._start()))
        self.halt.on_click(harmless(lambda _: self._halt()))
        self.fetch.on_click(harmless(lambda _: self._send()))

    def _start(self) -> None:
        queue, reason = self.session.queue, self.why_not()
        if len(self.path.keyframes) < 2:
            reason = "Add two keyframes or more to the camera path first."
        if reason is not None or queue.serves(FILM):
            self.said.content = reason or BUSY
            return
        folder = None
        try:
            folder = new_folder(self.folder)
            self.job = self._job(folder)
        except (InputError, OSError) as error:
            if folder is not None:
                remove_new_folder(folder)
            text = str(error) if isinstance(error, InputError) else not_saved(error)
            self.said.content = as_plain_markdown(text, MOST_SAID)
            return
        self._show(self.job)
        queue.add(FILM, self.job)

    def _job(self, folder: Path) -> FilmJob:
        return FilmJob(
            folder,
            self.path,
            self.session.queue.renderer,
            within(int(self.width.value), limits.LEAST_FILM_WIDTH, limits.MOST_FILM_WIDTH),
            within(int(self.rate.value), 1, limits.MOST_FILM_RATE),
            FilmSettings(crop=self.session.crop_corners),
            self.session.queue.complaints.harmless(self._show),
        )

    def _halt(self) -> None:
        if self.job is not None:
            self.job.stop()
            self.session.queue.wake()

    def _show(self, job: FilmJob) -> None:
        """Show how far it is; called by who renders."""
        if job.is_over:
            self.session.queue.remove(FILM)
        if not self.session.is_here():
            return
        self.halt.visible = self.bar.visible = not job.is_over
        self.render.visible = job.is_over
        self.fetch.visible = job.result is not None
        self.bar.value = 100.0 * job.done / max(1, job.total)
        self.said.content = _state(job)

    def _send(self) -> None:
        film = None if self.job is None else self.job.result
        if film is None:
            return
        try:
            if film.stat().st_size > limits.MOST_DOWNLOAD_BYTES:
                where = as_plain_markdown(str(film), MOST_SAID)
                self.said.content = f"It is too large to be sent to a browser, and lies at {where}"
                return
            content = film.read_bytes()
        except OSError as error:
            self.said.content = as_plain_markdown(f"The film cannot be read any more: {error}", MOST_SAID)
            return
        self.session.client.send_file_download(f"{film.parent.name}{film.suffix}", content, save_immediately=True)


def _state(job: FilmJob) -> str:
    if job.failure is not None:
        return as_plain_markdown(job.failure, MOST_SAID)
    if job.result is not None:
        return f"The film is at {as_plain_markdown(str(job.result), MOST_SAID)}"
    return "Making the video ..." if job.done == job.total else f"Frame {job.done} of {job.total}"
