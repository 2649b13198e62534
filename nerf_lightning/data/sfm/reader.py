"""Read photographs or a video without cameras: the cameras are found, cached, and reused."""

import hashlib
import json
import logging
from dataclasses import asdict, dataclass
from pathlib import Path

from nerf_lightning.compute import ranks
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.pixels.decoded_photographs import identity_of
from nerf_lightning.data.readers.auto import AutoReader
from nerf_lightning.data.readers.colmap import ColmapReader
from nerf_lightning.data.sfm.find_poses import from_photographs, from_video, remarks
from nerf_lightning.data.sfm.photograph_folder import files_in
from nerf_lightning.data.sfm.reconstruction import require_pycolmap
from nerf_lightning.data.sfm.settings import Panoramas, SfmSettings
from nerf_lightning.files.folders import default_folder
from nerf_lightning.files.made_folders import make_own_folder
from nerf_lightning.messages.errors import InputError

log = logging.getLogger(__name__)


@dataclass
class PhotosReader(AutoReader):
    """Read photographs with unknown cameras; a folder of a known format is read in that format.

    Args:
        root: the folder of the photographs, or the parent of a folder `images`.
        video: a video instead of root.
        panoramas: whether the images are equirectangular panoramas; auto: if they say so, or if all are exactly twice
            as wide as high.
    """

    root: str | None = None  # type: ignore[assignment]
    name: str = "photos"
    video: str | None = None
    panoramas: Panoramas = "auto"

    def reader(self) -> CaptureReader:
        """Find the cameras, unless they are known, and return the reader of the result.

        Raises:
            InputError: there are no photographs, or their cameras cannot be found.
        """
        if (self.root is None) == (self.video is None):
            raise InputError(
                "scene=photos needs a folder of photographs (scene.root=DIR) or a video (scene.video=FILE), and not "
                "both."
            )
        if self.root is not None and self.known_format(self.folder()) is not None:
            return super().reader()
        found = ranks.from_first(self._cameras)
        log.info("cameras: cached in %s (scene.cache_dir=DIR changes the folder)", found)
        return ColmapReader(**self._chosen() | {"root": str(found), "name": self.name, "downscale": self.downscale})

    def _cameras(self) -> Path:
        """Return the folder of the capture, which is made if it does not exist."""
        source, settings = self._source(), SfmSettings(panoramas=self.panoramas)
        cache = default_folder("poses") if self.cache_dir is None else Path(self.cache_dir).expanduser() / "poses"
        folder = cache / _key(source, settings)
        if (folder / "sparse" / "0").is_dir():
            return folder
        require_pycolmap()
        make_own_folder(cache)
        log.info("cameras: unknown, so they are found first (nerf poses does only this, with more settings)")
        if self.video is not None:
            model, matching = from_video(source, None, folder, settings)
        else:
            model, matching = from_photographs(source, folder, settings)
        found, total = len(model.registered), len(model.registered) + len(model.left_out)
        log.info("cameras: found %d of %d, with an error of %.2f pixels", found, total, model.reprojection_error)
        for remark in remarks(model, matching, self.video is not None):
            log.warning("cameras: %s", remark)
        return folder

    def _source(self) -> Path:
        if self.video is not None:
            return Path(self.video).expanduser()
        folder = self.folder()
        within = folder / "images"
        return within if within.is_dir() and not files_in(folder)[1] else folder


def _key(source: Path, settings: SfmSettings) -> str:
    """Return the cache key of found cameras: the photographs' names, sizes and modification times, and the settings."""
    try:
        files = files_in(source)[1] if source.is_dir() else [source]
    except OSError as error:
        raise InputError(f"{source} cannot be read: {error.strerror}. Check scene.root or scene.video.") from error
    content = [[identity_of(path) for path in files], asdict(settings)]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:24]
