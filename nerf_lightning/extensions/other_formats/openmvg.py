"""openMVG's `sfm_data.json`: views, intrinsics and poses by ID, as cereal writes them."""

from pathlib import Path
from typing import Any

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.readers.json_frames import path_of
from nerf_lightning.extensions.other_formats.posed import (
    Format,
    Intrinsics,
    Pose,
    Posed,
    PosedReader,
    Size,
    entries,
    from_rotation_and_center,
    number,
    numbers,
    panorama,
    sparse_points,
)
from nerf_lightning.files.json_files import mapping, read_json
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.types.scene import LensModel

LENSES: dict[str, tuple[LensModel, str, tuple[int, ...]]] = {
    "pinhole": ("pinhole", "", ()),
    "pinhole_radial_k1": ("radial_tangential", "disto_k1", (0,)),
    "pinhole_radial_k3": ("radial_tangential", "disto_k3", (0, 1, 2)),
    "pinhole_brown_t2": ("radial_tangential", "disto_t2", (0, 1, 2, 4, 5)),
    "fisheye": ("fisheye", "fisheye", (0, 1, 2, 3)),
}
"""By name of the type: the kind of lens, the key of its parameters, and which of k1, k2, k3, k4, p1, p2 they are."""
IS_NEW = 1 << 31
"""Flag that cereal adds to a type's ID at its first occurrence, with its name."""


def _read(reader: PosedReader, path: Path) -> Capture:
    """Read the views that have a pose. A rotation is world to camera, in row-major order, with the camera's center."""
    content = read_json(path)
    where = f"{path} of openMVG"
    poses, cameras = _by_key(content, "extrinsics", where), _intrinsics(content, where)
    if not poses:
        raise InputError(f"{where} has no poses (extrinsics): take the file that the reconstruction has written.")
    views = {f"views {key}": _data(value) for key, value in _by_key(content, "views", where).items()}
    posed = {place: view for place, view in views.items() if str(view.get("id_pose")) in poses}

    def picture(view: dict[str, Any], where: str) -> Posed:
        name = path_of(view.get("filename"), "filename", where)
        folder, intrinsic = view.get("local_path") or "", str(view.get("id_intrinsic"))

        def camera(_: Size) -> tuple[Pose, Intrinsics]:
            if intrinsic not in cameras:
                raise InputError(f"{where} has id_intrinsic {intrinsic}, which is not among the intrinsics.")
            pose = mapping(poses[str(view["id_pose"])])
            rotation = numbers(pose.get("rotation"), 9, f"{where}: rotation")
            center = numbers(pose.get("center"), 3, f"{where}: center")
            said, kind = cameras[intrinsic]
            return from_rotation_and_center(rotation, center, where), _camera(said, kind, f"{where}: intrinsics")

        return Posed(f"{folder}/{name}" if isinstance(folder, str) and folder else name, where, camera)

    structure = _by_key(content, "structure", where) if mapping(content).get("structure") else {}
    points = sparse_points([mapping(point).get("X") for point in structure.values()], path)
    found = reader.posed(path, posed, picture, points=points)
    found.left_out.without_pose = tuple(
        str(view.get("filename")) for place, view in views.items() if place not in posed
    )
    return found


def _by_key(content: object, name: str, where: str) -> dict[Any, Any]:
    """Return a map from cereal's list of keys and values."""
    items = [item for item in entries(content, name, where) if isinstance(item, dict)]
    return {str(item["key"]): item.get("value") for item in items if isinstance(item.get("key"), (int, str))}


def _data(value: object) -> dict[str, Any]:
    """Return the target of a cereal pointer."""
    return mapping(mapping(mapping(value).get("ptr_wrapper")).get("data"))


def _intrinsics(content: object, where: str) -> dict[Any, tuple[dict[str, Any], str]]:
    """Return the intrinsics with their types; a type is named at its first occurrence, and later has only its ID."""
    names, found = dict[int, str](), {}
    for key, value in _by_key(content, "intrinsics", where).items():
        kind, name = mapping(value).get("polymorphic_id"), mapping(value).get("polymorphic_name")
        if isinstance(kind, int):
            if isinstance(name, str):
                names[kind % IS_NEW] = name
            name = names.get(kind % IS_NEW, name)
        found[key] = (_data(value), str(name))
    return found


def _camera(said: dict[str, Any], kind: str, where: str) -> Intrinsics:
    base = mapping(said.get("value0")) or said  # in some versions
    width, height = number(base, "width", where), number(base, "height", where)
    if kind == "spherical":
        return panorama((width, height))
    if kind not in LENSES:
        raise InputError(
            f"{where}: {kind} is not supported ({listed(LENSES, len(LENSES))} are). Undistort the photographs "
            "(openMVG_main_ExportUndistortedImages)."
        )
    lens_model, key, places = LENSES[kind]
    lens = [0.0] * 6
    for place, value in zip(places, numbers(said.get(key, []), len(places), f"{where}: {key}"), strict=True):
        lens[place] = value
    k1, k2, k3, k4, p1, p2 = lens
    focal = number(base, "focal_length", where)
    x, y = numbers(base.get("principal_point"), 2, f"{where}: principal_point")
    return Intrinsics((focal, focal), (x, y), (width, height), lens_model, (k1, k2, k3, k4, p1, p2))


FORMAT = Format("openMVG", (("sfm_data*.json", '"sfm_data_version"'), ("*.json", '"sfm_data_version"')), _read)
