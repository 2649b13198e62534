"""Polycam's raw data: `keyframes/` with a JSON file of pose and intrinsics per photograph, and LiDAR depth maps."""

from dataclasses import dataclass
from pathlib import Path

from nerf_lightning.data.captures.capture import Capture, View
from nerf_lightning.data.captures.checks import pose_from_matrix
from nerf_lightning.data.captures.find_pictures import pictures_below, pictures_by_stem
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.pixels.decoded_photographs import Photograph
from nerf_lightning.data.pixels.picture_files import read_header
from nerf_lightning.data.readers.json_frames import number_of
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.json_files import read_json
from nerf_lightning.messages.errors import InputError

FOLDERS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
"""Of poses and photographs: those refined by the app, then those as recorded."""


@dataclass
class PolycamReader(CaptureReader):
    """Read the raw data that Polycam exports in its developer mode. Units are meters; y is up.

    Args:
        depth_unit: length of one level of the 16-bit depth maps, in meters.
    """

    name: str = "polycam"
    depth_unit: float = 1e-3

    @classmethod
    def found_in(cls, folder: Path) -> str | None:
        """Return the folder by which this format is recognized, if a folder has it."""
        found = _folders_in(folder)
        return None if found is None else found[0].relative_to(folder).as_posix()

    def capture(self) -> Capture:
        """Return the photographs, sorted by name."""
        keyframes = self.folder() / "keyframes"
        cameras, pictures = _folders_in(self.folder()) or (keyframes / FOLDERS[-1][0], keyframes / FOLDERS[-1][1])
        files = pictures_by_stem(pictures)
        poses = sorted(cameras.glob("[!.]*.json"))
        require_within("views", len(poses), cameras, "views")
        left_out, views = LeftOut(str(cameras)), []
        for path in poses:
            with left_out.unless_usable(path.stem):
                if path.stem not in files:
                    raise InputError(f"{pictures} holds no photograph of the pose {path.name}. Copy it there.")
                views.append(_view(path, files[path.stem], keyframes / "depth" / f"{path.stem}.png"))
        left_out.require_enough(len(views))
        posed = {path.stem for path in poses}
        left_out.without_pose = tuple(file.name for stem, file in files.items() if stem not in posed)
        return Capture(tuple(views), cameras, left_out=left_out, depth_unit=self.depth_unit)


def _folders_in(root: Path) -> tuple[Path, Path] | None:
    """Return the folders of poses and of photographs, preferring a pair with both; None if there are no poses."""
    found = [(root / "keyframes" / poses, root / "keyframes" / pictures) for poses, pictures in FOLDERS]
    found = [(poses, pictures) for poses, pictures in found if next(poses.glob("[!.]*.json"), None)]
    whole = [(poses, pictures) for poses, pictures in found if next(iter(pictures_below(pictures)), None)]
    return next(iter((*whole, *found)), None)


def _view(path: Path, picture: Path, depth: Path) -> View:
    said = read_json(path)
    if not isinstance(said, dict):
        raise InputError(f"{path} is not a JSON object with a pose. Export the capture again.")
    matrix = [[number_of(said, f"t_{row}{column}", str(path)) for column in range(4)] for row in range(3)]
    fx, fy, cx, cy = (number_of(said, key, str(path)) for key in ("fx", "fy", "cx", "cy"))
    header = read_header(picture)
    stored = dict(zip(("width", "height"), map(float, header.size), strict=True))  # refined ones lack them
    width, height = (number_of(said, key, str(path), default) for key, default in stored.items())
    return View(
        name=picture.name,
        photograph=Photograph(picture, header=header),
        c2w=pose_from_matrix(matrix, str(path)),
        focal=(fx, fy),
        center=(cx, cy),
        size=(width, height),
        depth=depth if depth.is_file() else None,
    )
