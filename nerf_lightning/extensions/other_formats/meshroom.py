"""Meshroom's cameras (AliceVision): `cameras.sfm` or `sfm.json`, with views, intrinsics and poses by ID."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.checks import pose_from_matrix
from nerf_lightning.data.readers.json_frames import path_of
from nerf_lightning.extensions.other_formats.posed import (
    Format,
    Intrinsics,
    Pose,
    Posed,
    PosedReader,
    Size,
    entries,
    number,
    numbered,
    numbers,
    panorama,
    sparse_points,
)
from nerf_lightning.files.json_files import keys_of, mapping, read_json
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.poses import flip_yz
from nerf_lightning.nerf.types.scene import LensModel

LENSES: dict[str, tuple[LensModel, tuple[int, ...]]] = {
    "none": ("pinhole", ()),
    "radialk1": ("radial_tangential", (0,)),
    "radialk3": ("radial_tangential", (0, 1, 2)),
    "brown": ("radial_tangential", (0, 1, 2, 4, 5)),
    "fisheye4": ("fisheye", (0, 1, 2, 3)),
}
"""By type of distortion: the kind of lens, and which of k1, k2, k3, k4, p1, p2 its parameters are."""
OLD_NAMES = {"pinhole": "none", "radial1": "radialk1", "radial3": "radialk3"}
"""Until version 1.2.6 the intrinsics' type named the distortion, too."""
DEFAULT_SENSOR = 36.0
"""Default width in millimeters."""


def _read(reader: PosedReader, path: Path) -> Capture:
    """Read the views that have a pose. A rotation is world to camera, column-major; poses of rigs are composed."""
    content = read_json(path)
    views = entries(content, "views", f"{path} of Meshroom (AliceVision)")
    file = _File.read(content, str(path))
    unposed = tuple(str(view.get("path")) for view in views if isinstance(view, dict) and file.has_no_pose(view))
    posed = [view for view in views if not (isinstance(view, dict) and file.has_no_pose(view))]
    if not posed:
        raise InputError(
            f"{path} of Meshroom (AliceVision) has no poses: take what the node StructureFromMotion has written."
        )
    structure = entries({"structure": content.get("structure") or []}, "structure", str(path))
    points = sparse_points([mapping(point).get("X") for point in structure], path)
    found = reader.posed(path, numbered("views", posed), file.posed, points=points)
    found.left_out.without_pose = unposed
    return found


@dataclass(frozen=True)
class _File:
    """What the views of a file refer to by ID."""

    version: tuple[int, ...]
    intrinsics: dict[str, dict[str, Any]]
    poses: dict[str, dict[str, Any]]
    rigs: dict[str, dict[str, Any]]

    @classmethod
    def read(cls, content: dict[str, Any], where: str) -> "_File":
        def by_number(key: str, number: str) -> dict[str, dict[str, Any]]:
            found = entries({key: content.get(key) or []}, key, where)  # an empty list is written as ""
            return {str(each.get(number)): each for each in found if isinstance(each, dict)}

        version = numbers(content.get("version", [1, 0, 0]), 3, f"{where}: version")
        tables = by_number("intrinsics", "intrinsicId"), by_number("poses", "poseId"), by_number("rigs", "rigId")
        return cls(tuple(map(int, version)), *tables)

    def has_no_pose(self, view: dict[str, Any]) -> bool:
        return str(view.get("poseId", view.get("viewId"))) not in self.poses

    def posed(self, view: object, where: str) -> Posed:
        path, intrinsic = keys_of(view, ("path", "intrinsicId"), where, "Meshroom")
        said = self.intrinsics.get(str(intrinsic))

        def camera(picture: Size) -> tuple[Pose, Intrinsics]:
            if said is None:
                raise InputError(f"{where} has intrinsicId {intrinsic}, which is not among the intrinsics.")
            return self._pose(mapping(view), where), self._intrinsics(said, f"{where}: intrinsics {intrinsic}")

        return Posed(path_of(path, "path", where), where, camera)

    def _pose(self, view: dict[str, Any], where: str) -> Pose:
        pose = self.poses[str(view.get("poseId", view.get("viewId")))]
        c2w = _opencv_pose(mapping(mapping(pose.get("pose")).get("transform")), f"{where}: its pose")
        rig = self.rigs.get(str(view.get("rigId")))
        alone = view.get("isPoseIndependant", "false" if self.version < (1, 2, 0) else "true")
        if rig is None or str(alone).lower() in ("1", "true"):
            return flip_yz(c2w)
        parts, index = entries(rig, "subPoses", f"{where}: its rig"), int(number(view, "subPoseId", where, -1))
        if not 0 <= index < len(parts):
            raise InputError(f"{where} has subPoseId {index}, but its rig has {len(parts)} cameras. Export it again.")
        part = _opencv_pose(mapping(mapping(parts[index]).get("pose")), f"{where}: its place in the rig")
        return flip_yz(torch.cat([c2w[:, :3] @ part[:, :3], c2w[:, :3] @ part[:, 3:] + c2w[:, 3:]], dim=1))

    def _intrinsics(self, said: dict[str, Any], where: str) -> Intrinsics:
        width, height = number(said, "width", where), number(said, "height", where)
        if said.get("type") == "equirectangular":
            return panorama((width, height))
        kind = said.get("distortionType", OLD_NAMES.get(str(said.get("type")), said.get("type")))
        if said.get("type") not in ("pinhole", *OLD_NAMES, *LENSES) or kind not in LENSES:
            raise InputError(
                f"{where} has the lens {said.get('type')} {said.get('distortionType', '')}, which is not supported "
                f"({listed(LENSES, len(LENSES))} are). Undistort the photographs (the node PrepareDenseScene)."
            )
        lens_model, places = LENSES[kind]
        lens, values = [0.0] * 6, said.get("distortionParams") or []
        if values:
            for place, value in zip(places, numbers(values, len(places), f"{where}: distortionParams"), strict=True):
                lens[place] = value
        x, y = numbers(said.get("principalPoint"), 2, f"{where}: principalPoint")
        center = (x, y) if self.version < (1, 2, 1) else (width / 2 + x, height / 2 + y)
        k1, k2, k3, k4, p1, p2 = lens
        return Intrinsics(
            self._focal(said, width, where), center, (width, height), lens_model, (k1, k2, k3, k4, p1, p2)
        )

    def _focal(self, said: dict[str, Any], width: float, where: str) -> tuple[float, float]:
        """Return the focal lengths in pixels; depending on its version, the file has pixels or millimeters."""
        if self.version < (1, 2, 0):
            return (number(said, "pxFocalLength", where),) * 2
        if self.version < (1, 2, 2):
            x, y = numbers(said.get("pxFocalLength"), 2, f"{where}: pxFocalLength")
            return x, y
        sensor, ratio = number(said, "sensorWidth", where, DEFAULT_SENSOR), number(said, "pixelRatio", where, 1.0)
        if not (sensor > 0 and ratio > 0):
            raise InputError(f"{where}: sensorWidth is {sensor:g} and pixelRatio {ratio:g}; both must be above 0.")
        x = number(said, "focalLength", where) / sensor * width
        return x, (x / ratio if self.version < (1, 2, 5) else x * ratio)


def _opencv_pose(transform: dict[str, Any], where: str) -> Pose:
    """Return camera to world with axes right, down, forward; its rows are the columns of world to camera."""
    rotation = torch.tensor(numbers(transform.get("rotation"), 9, f"{where}: rotation"), dtype=torch.float64)
    center = torch.tensor(numbers(transform.get("center"), 3, f"{where}: center"), dtype=torch.float64)
    return pose_from_matrix(torch.cat([rotation.reshape(3, 3), center[:, None]], dim=1), where)


WORDS = '"(viewId|intrinsicId)"'
FORMAT = Format("Meshroom (AliceVision)", (("*.sfm", WORDS), ("*.json", WORDS)), _read)
