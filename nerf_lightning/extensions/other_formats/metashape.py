"""Agisoft Metashape's cameras (File > Export > Export Cameras, Agisoft XML) next to the photographs."""

import logging
import math
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.data.captures.capture import Capture, View, of_one_lens
from nerf_lightning.data.captures.checks import pose_from_matrix
from nerf_lightning.data.captures.find_pictures import find_pictures
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.pixels.decoded_photographs import Photograph
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.signatures import file_with, files_with
from nerf_lightning.files.xml_files import read_xml
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.poses import flip_yz, is_rigid
from nerf_lightning.nerf.geometry.world_frame import LARGEST_UNIT, LEAST_UNIT
from nerf_lightning.nerf.types.scene import LensModel

SIGNATURE = ("*.xml", r"\A(?=[\s\S]*?<document)[\s\S]*?<chunk")
LENSES: dict[str, LensModel] = {"frame": "radial_tangential", "fisheye": "fisheye", "spherical": "equirectangular"}
"""By a sensor's type."""
OFF = ("0", "false")
"""Values of `enabled` for disabled cameras."""
OF_ITS_OWN = ("b2", "p3", "p4")
"""Skew, and the higher tangential terms."""
CURE = "Export the cameras again (Agisoft XML)."

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Sensor:
    """A camera's intrinsics."""

    lens_model: LensModel
    size: tuple[float, float]
    focal: tuple[float, float]
    center: tuple[float, float]
    lens: tuple[float, float, float, float, float, float]


class Aligned(NamedTuple):
    """A camera, and the one whose transform it uses: itself, or the master of its rig."""

    label: str
    camera: Element
    posed: Element

    @property
    def component(self) -> str:
        """Return the ID of the component that was aligned together."""
        return self.posed.get("component_id", "")


@dataclass
class MetashapeReader(CaptureReader):
    """Read the cameras of the first chunk that has any, including those in groups; unaligned ones have no pose.

    Of several components, whose frames differ, the largest is read. Slaves of a rig have their master's pose times
    their sensor's pose in the rig.

    Args:
        file: the XML file below root; null: the only one there.
    """

    named_by = (".xml",)

    name: str = "metashape"
    file: str | None = None

    @classmethod
    def found_in(cls, folder: Path) -> str | None:
        """Return the file by which this format is recognized, if a folder has it."""
        return file_with(folder, SIGNATURE)

    def capture(self) -> Capture:
        """Return the aligned photographs, in the file's order."""
        root = self.folder()
        path = self._path(root)
        chunk = _chunk(path)
        left_out = LeftOut(str(path))
        cameras = _named(chunk)
        require_within("views", len(cameras), path, "views")
        sensors = {each.get("id", ""): each for each in chunk.iterfind("sensors//sensor")}
        component, aligned = _largest(list(_aligned(cameras)), chunk, path)
        labels = [label for label, _ in cameras]
        pictures = find_pictures(labels, root / "images", root, path, self.allow_outside)
        views, lenses = [], list[LensModel]()
        for label, camera, posed in aligned:
            with left_out.unless_usable(label):
                if label not in pictures:
                    raise InputError(f"{path}: no picture below {root} is called {label}. Copy it there.")
                number = camera.get("sensor_id", "")
                sensor = _sensor(sensors.get(number), number, path)
                c2w = _matrix(posed, f"{path}: the transform of {label}", path)
                if camera is not posed:
                    c2w = c2w @ _place_in_rig(sensors[number], f"{path}: the sensor {number} of {label}", path)
                views.append(_view(c2w[:3], label, sensor, pictures[label]))
                lenses.append(sensor.lens_model)
        left_out.require_enough(len(views))
        if terms := sorted(
            {each.tag for each in chunk.iter() if each.tag in OF_ITS_OWN and (each.text or "0").strip(" 0.")}
        ):
            log.warning("%s: the lens has %s, which is not supported and is left out", path, " and ".join(terms))
        known = {view.name for view in views} | left_out.faults.keys()
        left_out.without_pose = tuple(label for label in labels if label not in known)
        undo = _to_world(component, path)
        return of_one_lens(Capture(tuple(views), path, undo=undo, left_out=left_out), lenses)

    def _path(self, root: Path) -> Path:
        """Return the file that the user named, or the only one."""
        named = Path(self.root).expanduser()
        if self.file is not None or os.path.isfile(named):
            return named if self.file is None else root / self.file
        found = [root / name for name in files_with(root, SIGNATURE)]
        if len(found) == 1:
            return found[0]
        if not found:
            raise InputError(f"{root} holds no xml of Metashape's cameras. Export them there, or set scene.file=NAME.")
        names = listed((path.name for path in found), 4)
        raise InputError(f"{root} holds {len(found)} files of Metashape's cameras ({names}). Give scene.root=FILE.")


def _chunk(path: Path) -> Element:
    """Return the first chunk that has aligned cameras, or else the first with cameras."""
    chunks = [chunk for chunk in read_xml(path, CURE).iterfind("chunk") if chunk.find("cameras//camera") is not None]
    if not chunks:
        raise InputError(f"{path} holds no chunk of cameras. {CURE}")
    aligned = [chunk for chunk in chunks if chunk.find("cameras//camera/transform") is not None] or chunks
    if len(chunks) > 1:
        log.warning(
            "%s: of %d chunks the first with aligned cameras is read. To read another, export it alone",
            *(path, len(chunks)),
        )
    return aligned[0]


def _sensor(sensor: Element | None, number: str, path: Path) -> Sensor:
    kind = "" if sensor is None else sensor.get("type", "frame")
    resolution = None if sensor is None else sensor.find("resolution")
    if sensor is None or resolution is None or kind not in LENSES:
        raise InputError(
            f"{path}: the sensor {number} is absent, has no resolution, or is of another type than "
            f"{listed(LENSES)} ({kind}). {CURE}"
        )
    width, height = (_number(resolution.get(side), path) for side in ("width", "height"))
    if kind == "spherical":
        panorama = (width / (2 * math.pi), height / math.pi), (width / 2, height / 2)
        return Sensor("equirectangular", (width, height), *panorama, (0.0,) * 6)
    found = list(sensor.iterfind("calibration"))
    adjusted = next((each for each in found if each.get("class") == "adjusted"), found[0] if found else None)
    if adjusted is None:
        raise InputError(f"{path}: the sensor {number} has no calibration. Align the photographs, and export again.")

    def number_of(key: str) -> float:
        return _number(adjusted.findtext(key, "0"), path)

    f, b1 = number_of("f"), number_of("b1")
    # Metashape's P1 and P2 are OpenCV's p2 and p1; its principal point is relative to the center of the picture.
    k1, k2, k3, k4, p2, p1 = (number_of(key) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    center = (width / 2 + number_of("cx"), height / 2 + number_of("cy"))
    return Sensor(LENSES[kind], (width, height), (f + b1, f), center, (k1, k2, k3, k4, p1, p2))


def _view(c2w: Float[Tensor, "3 4"], label: str, sensor: Sensor, picture: Path) -> View:
    return View(
        name=label,
        photograph=Photograph(picture),
        c2w=flip_yz(c2w),
        focal=sensor.focal,
        center=sensor.center,
        size=sensor.size,
        lens=sensor.lens,
    )


def _named(chunk: Element) -> list[tuple[str, Element]]:
    """Return the cameras with their labels, in order; equal labels are prefixed with their group's."""
    found = list[tuple[str, str, Element]]()
    for each in chunk.iterfind("cameras/*"):
        group = each.get("label") or "" if each.tag == "group" else ""
        found += [(group, camera.get("label") or "", camera) for camera in each.iter("camera")]
    counts = Counter(label for _, label, _ in found)
    return [(f"{g}/{label}" if g and counts[label] > 1 else label, camera) for g, label, camera in found if label]


def _aligned(cameras: list[tuple[str, Element]]) -> Iterator[Aligned]:
    """Yield the cameras that have a transform, or whose master has one."""
    by_number = {camera.get("id"): camera for _, camera in cameras}
    for label, camera in cameras:
        posed = camera if camera.findtext("transform") else by_number.get(camera.get("master_id"))
        if posed is not None and posed.findtext("transform") and camera.get("enabled") not in OFF:
            yield Aligned(label, camera, posed)


def _largest(aligned: list[Aligned], chunk: Element, path: Path) -> tuple[Element, list[Aligned]]:
    """Return the component with most cameras, and these; the chunk replaces one without a transform."""
    counts = Counter(each.component for each in aligned)
    number = max(counts, key=counts.__getitem__, default="")
    others = [each.label for each in aligned if each.component != number]
    if others:
        log.warning(
            "%s: %d photographs of %d other components, whose frames differ, are left out: %s. To read them, merge the "
            "components in Metashape, or export each alone",
            *(path, len(others), len(counts) - 1, listed(others, 3)),
        )
    described = (each for each in chunk.iterfind("components/component") if each.get("id") == number)
    component = next((each for each in described if each.find("transform") is not None), chunk)
    return component, [each for each in aligned if each.component == number]


def _place_in_rig(sensor: Element, where: str, path: Path) -> Float[Tensor, "4 4"]:
    """Return the transform from a slave's camera to its master's, axes right, down, forward."""
    rotation, location = (sensor.findtext(key, "").split() for key in ("rotation", "location"))
    if (len(rotation), len(location)) != (9, 3):
        raise InputError(f"{where} has no rotation and location in its rig, so it has no pose. {CURE}")
    rows = [word for row in range(3) for word in (*rotation[3 * row : 3 * row + 3], location[row])]
    return _matrix_of(_numbers(rows, path), where)


def _matrix(camera: Element, where: str, path: Path) -> Float[Tensor, "4 4"]:
    return _matrix_of(_numbers(camera.findtext("transform", "").split(), path), where)


def _matrix_of(numbers: list[float], where: str) -> Float[Tensor, "4 4"]:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3] = pose_from_matrix(numbers, where)
    return matrix


def _to_world(part: Element, path: Path) -> Float[Tensor, "4 4"]:
    """Return the transform from the frame of a component or a chunk to the world, if it is referenced."""
    matrix = torch.eye(4, dtype=torch.float64)
    transform = part.find("transform")
    if transform is None:
        return matrix
    rotation = _numbers(transform.findtext("rotation", "1 0 0 0 1 0 0 0 1").split(), path)
    shift = _numbers(transform.findtext("translation", "0 0 0").split(), path)
    scale = _number(transform.findtext("scale", "1"), path)
    if (len(rotation), len(shift)) == (9, 3):
        matrix[:3] = torch.cat([matrix.new_tensor(rotation).reshape(3, 3), matrix.new_tensor(shift)[:, None]], dim=1)
    if (len(rotation), len(shift)) != (9, 3) or not is_rigid(matrix[:3]) or not LEAST_UNIT <= scale <= LARGEST_UNIT:
        raise InputError(f"{path}: the chunk's transform is not a rotation, a shift and a scale. {CURE}")
    matrix[:3, :3] *= scale
    return matrix


def _number(word: str | None, path: Path) -> float:
    (number,) = _numbers([word or ""], path)
    return number


def _numbers(words: list[str], path: Path) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        raise InputError(f"{path} holds {' '.join(words)!r} where numbers of a camera belong. {CURE}") from None
