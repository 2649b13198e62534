"""The camera path that comes with a page: as the person says, else what was recorded last, else the film's."""

import logging
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.video.paths.as_keyframes import as_keyframes
from nerf_lightning.video.paths.auto import AutoPath
from nerf_lightning.video.paths.base import CameraPath, frame_of
from nerf_lightning.video.paths.keyframe_path import KeyframePath
from nerf_lightning.viewer.recorded_path import RecordedPath

Keyframes = tuple[dict[str, Any], ...]

log = logging.getLogger(__name__)


def page_path(path: CameraPath, record: SceneRecord, run: Path) -> Keyframes:
    """Return the keyframes of a path; of path=auto, those that `nerf view` saved last in the run's folder.

    Raises:
        InputError: the path cannot be laid around the scene.
    """
    around = frame_of(record.cameras, record.aabb, to_user=record.to_user, view_names=record.view_names)
    if not isinstance(path, AutoPath):
        return tuple(map(asdict, as_keyframes(path, around)))
    folder = run / "viewer"
    recorded = [] if folder.is_symlink() else RecordedPath(around, folder).files()
    for name in recorded[:1]:
        try:
            found = as_keyframes(KeyframePath(str(folder / name)), around)
            log.info("the page plays %s", folder / name)
            return tuple(map(asdict, found))
        except InputError as error:
            log.warning("The page does not play what was recorded last: %s", error)
    try:
        return tuple(map(asdict, as_keyframes(path, around)))
    except InputError as error:
        log.warning("The page is without a camera path: %s", error)
        return ()
