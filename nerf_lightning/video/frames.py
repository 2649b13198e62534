"""The frames of a film on disk: each is written as soon as it is rendered, so an interrupted film can continue.

`.frames/film.json` in the output folder says which film the frames belong to (a fingerprint of all that decides what is
seen) and the range of depths of their colors.
"""

import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor

from nerf_lightning.data.pixels.picture_files import read_rgba
from nerf_lightning.files.json_files import read_json_object, write_json
from nerf_lightning.files.made_folders import ScratchFolder, child_of, empty_ours, make_folder, make_ours
from nerf_lightning.messages.console import tracked
from nerf_lightning.messages.errors import InputError
from nerf_lightning.video.encoding import write_animation, write_video
from nerf_lightning.video.settings import ENDINGS, Form

Range = tuple[float, float]
HIDDEN = ".frames"

log = logging.getLogger(__name__)


class FilmFrames:
    """Frames of one or more films of equal length.

    Args:
        films: names of the films, which are written to `folder`.
        count: number of frames of each.
        form: with `frames` and `exr`, frames are the result; other forms keep them in a hidden folder until they are
            encoded to a file.
        transparent: the films whose frames have alpha.
    """

    def __init__(
        self,
        folder: Path,
        films: Sequence[str],
        count: int,
        form: Form,
        transparent: Collection[str] = (),
    ) -> None:
        self.folder, self.films, self.count, self.form = folder, films, count, form
        self.transparent = transparent
        self.scratch = ScratchFolder(folder, HIDDEN, "is filming")
        self.root = self.scratch.path if ENDINGS[form] else folder
        self.suffix = ".exr" if form == "exr" else ".png"

    def open(self, fingerprint: str, measure: Callable[[], Range]) -> tuple[list[int], Range]:
        """Lock the folder, and return the missing frames and the range of the depth's colors.

        If the frames belong to another film, they are removed, and the range is measured again. A folder that another
        process writes to, or that has foreign files, is refused.
        """
        with self._catch_os_errors():
            self.scratch.hold()
            kept = [] if ENDINGS[self.form] else self.films
            results = [make_ours(self.folder, film, files=self._pattern) for film in kept]
        about = self.scratch.path / "film.json"
        note = read_json_object(about)
        if note.get("fingerprint") != fingerprint or not _is_range(note.get("depth_range")):
            with self._catch_os_errors():
                empty_ours(self.scratch.path)
                for folder in results:
                    empty_ours(folder, self._pattern)
            note = {"fingerprint": fingerprint, "depth_range": list(measure())}
            with self._catch_os_errors():
                write_json(about, note)
        missing = [number for number in range(self.count) if not self._is_there(number)]
        if len(missing) < self.count:
            there = self.count - len(missing)
            log.info("%d of %d frames exist already: rendering the missing ones", there, self.count)
        near, far = note["depth_range"]
        return missing, (near, far)

    def save(self, film: str, number: int, write: Callable[[Path], None]) -> None:
        """Save one frame, which `write` writes to a file."""
        with self._resumable():
            file = self._file(film, number)
            make_folder(self.folder, *file.parent.relative_to(self.folder).parts)
            write(file)

    def finish(self, fps: int) -> None:
        """Make films from the frames, remove these, and unlock the folder; on an error the frames stay."""
        if ENDINGS[self.form]:
            write = write_animation if self.form == "animation" else write_video
            for film, file in zip(self.films, self.results(), strict=True):
                with self._resumable():
                    write(file, self._read(film), fps, self.count)
            self.scratch.remove()
        else:
            self.close()

    def close(self) -> None:
        """Unlock the folder; the frames stay."""
        self.scratch.release()

    def results(self) -> list[Path]:
        """Return the files, or the folders of frames."""
        return [child_of(self.folder, film, ending=ENDINGS[self.form]) for film in self.films]

    @property
    def _pattern(self) -> str:
        return f"frame_*{self.suffix}"

    def _file(self, film: str, number: int) -> Path:
        return child_of(self.root, film, f"frame_{number:04d}", ending=self.suffix)

    def _is_there(self, number: int) -> bool:
        files = [self._file(film, number) for film in self.films]
        return all(file.is_file() and file.stat().st_size > 0 for file in files)

    def _read(self, film: str) -> Iterator[UInt8[Tensor, "height width channels"]]:
        numbers, channels = range(self.count), 4 if film in self.transparent else 3
        for number in tracked(numbers, f"encoding {film}"):
            file = self._file(film, number)
            try:
                yield torch.from_numpy(read_rgba(file)[..., :channels].copy())
            except InputError as error:
                raise InputError(f"The frame {file} cannot be read. Remove it.") from error

    @contextmanager
    def _catch_os_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            where = error.filename or self.folder
            raise InputError(f"{where}: {error.strerror or error}. See that there is space left.") from error

    @contextmanager
    def _resumable(self) -> Iterator[None]:
        try:
            with self._catch_os_errors():
                yield
        except InputError as error:
            there = sum(map(self._is_there, range(self.count)))
            raise InputError(
                f"{error} {there} of {self.count} frames are kept in {self.root}: run the same command again to render "
                "the missing ones."
            ) from error


def _is_range(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(isinstance(each, (int, float)) for each in value)
