"""Read a capture of any known format: the files in its folder, or in one just below or above, determine it."""

import importlib
import inspect
import logging
import os
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any, Literal

import yaml

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.folders import located, named_folder, require_one
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.readers.base import Reader
from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.data.readers.colmap import ColmapReader
from nerf_lightning.data.readers.llff import LlffReader
from nerf_lightning.data.readers.transforms import TransformsReader
from nerf_lightning.files.folders import conf_file, option_names
from nerf_lightning.files.regular import contents
from nerf_lightning.files.signatures import Signature, file_with, other_format
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.types.scene import Scene

FIRST: tuple[type[CaptureReader], ...] = (BlenderReader, TransformsReader, ColmapReader, LlffReader)
"""If a folder has the files of several, the first one says more: a COLMAP model has lenses and points, which the
poses_bounds.npy next to it lacks."""

log = logging.getLogger(__name__)


@cache
def readers() -> tuple[type[CaptureReader], ...]:
    """Return the readers of formats recognized by files: `FIRST`, then the others that YAMLs in `scene/` name."""
    texts = (conf_file(f"scene/{name}").read_text(encoding="utf-8") for name in option_names("scene"))
    targets = (str(yaml.safe_load(text)["_target_"]).rpartition(".") for text in texts)
    classes = (getattr(importlib.import_module(module), name) for module, _, name in targets)
    found = [
        each
        for each in classes
        if each not in FIRST and any("found_in" in vars(base) for base in each.__mro__ if base is not Reader)
    ]
    return (*FIRST, *dict.fromkeys(found))


@dataclass(frozen=True)
class DetectedFormat:
    """A folder of known format."""

    folder: Path
    file: str
    """The file that determines the format."""
    reader: type[CaptureReader]

    @property
    def scene(self) -> str:
        """Name of the format for scene=."""
        return str(inspect.signature(self.reader).parameters["name"].default)


@dataclass
class AutoReader(CaptureReader):
    """Read a folder in the format that its files determine.

    Settings left at their defaults have the defaults of the format's own reader.

    Args:
        images: the folder of the photographs below root; null: the format's own.
    """

    name: str = "auto"
    downscale: int | Literal["auto"] = "auto"
    images: str | None = None

    def read(self) -> Scene:
        """Return the capture like the format's own reader.

        Raises:
            InputError: the format is unknown or does not have a setting, or anything is wrong with the files.
        """
        return self.reader().read()

    def folder(self) -> Path:
        """Return the folder that the user named."""
        return named_folder(self.root)

    def capture(self) -> Capture:
        """Return the content of the files."""
        return self.reader().capture()

    def reader(self) -> CaptureReader:
        """Return the reader of the format, and log which it is.

        Raises:
            InputError: the format is unknown, or does not have a setting.
        """
        detected = self._search()
        root = self.root if detected.folder == self.folder() else str(detected.folder)
        log.info("%s: read as scene=%s, because it has %s", root, detected.scene, detected.file)
        chosen = self._chosen() | {"root": self.root, "name": self.name, "downscale": self.downscale}
        if detected.reader is BlenderReader and self.downscale == "auto":  # renderings, which are small
            del chosen["downscale"]
        refused = sorted(chosen.keys() - inspect.signature(detected.reader).parameters.keys())
        if refused:
            raise InputError(
                f"scene.{refused[0]}: scene={detected.scene}, which {root} is, has no such setting. Leave it out."
            )
        reader = detected.reader(**chosen)
        if not os.path.isfile(Path(self.root).expanduser()):  # a file may be a part of what its reader searches for
            reader.found_folder = detected.folder
        return reader

    @staticmethod
    def known_format(folder: Path) -> DetectedFormat | None:
        """Return what a folder itself is; None if its format is unknown."""
        for reader in readers():
            if (file := reader.found_in(folder)) is not None:
                return DetectedFormat(folder, file, reader)
        return None

    def _search(self) -> DetectedFormat:
        """Return the folder's own format, or the only capture below it, or the one that contains it."""
        folder = self.folder()
        if (named := self._named_file()) is not None:
            return named
        found = located(folder, self.known_format)
        require_one([known.folder for known in found], self.root)
        if found:
            return found[0]
        path = Path(self.root).expanduser()
        if path.is_file() and (other := other_format(path)) is not None:
            raise InputError(f"{self.root} is {other}.")
        formats = listed((DetectedFormat(folder, "", reader).scene for reader in readers()), len(readers()))
        raise InputError(
            f"{self.root} holds no capture in a known format ({formats}): it holds {contents(folder)}.{self._hint()} "
            "If these are photographs without cameras, use scene=photos."
        )

    def _named_file(self) -> DetectedFormat | None:
        """Return the reader of the file that the user named, if it belongs to a capture."""
        path = Path(self.root).expanduser()
        fitting = [reader for reader in readers() if path.suffix.lower() in reader.named_by]
        if not fitting or not os.path.isfile(path):
            return None
        likeliest = [each for each in fitting if each in FIRST] or fitting
        known = (each for each in fitting if path.name in (each.found_in(path), each.found_in(path.parent)))
        reader = next(known, likeliest[-1])
        return DetectedFormat(self.folder(), path.name, reader)

    def _hint(self) -> str:
        """Return which program wrote the folder, if that is clear, and how to read its captures."""
        folder = self.folder()
        fitting = (words for files, words in OF_OTHERS if all(file_with(folder, file) for file in files))
        return next((f" {words}" for words in fitting), "")

    def _chosen(self) -> dict[str, Any]:
        """Return the settings that differ from their defaults."""
        values = {field.name: (getattr(self, field.name), field.default) for field in fields(AutoReader)}
        return {name: value for name, (value, default) in values.items() if value != default}


OF_OTHERS: tuple[tuple[tuple[Signature, ...], str], ...] = (
    (
        (("metadata.json", '"(perFrameIntrinsicCoeffs|poses|fps|K)"'), ("rgb*", "")),
        "It looks like an export of Record3D: convert it with nerfstudio (ns-process-data record3d), which writes a "
        "transforms.json.",
    ),
    (
        (("*.r3d", ""),),
        "A .r3d file of Record3D is an archive: unpack it, and convert it with nerfstudio (ns-process-data).",
    ),
    (
        (("*.csv", r"\A#?name,x,y,(alt|z),"),),
        "It holds RealityScan's (RealityCapture's) list of cameras as csv: export its COLMAP format instead.",
    ),
    (
        (("*.xmp", ""),),
        "XMP files next to photographs are RealityScan's cameras: export its COLMAP format instead.",
    ),
    (
        (("point_cloud", ""),),
        "It looks like the output of 3DGS (Gaussian splats): read the capture that it was made of, whose folder "
        "cfg_args names as source_path.",
    ),
    (
        (("camera*.json", '"projection_type"'),),
        "It holds cameras of OpenSfM or ODM, but not their poses: copy reconstruction.json there (of an ODM project, "
        "opensfm/reconstruction.json).",
    ),
    (
        (("*.mg", ""),),
        "A .mg is a project of Meshroom: give the folder in MeshroomCache/StructureFromMotion that holds cameras.sfm.",
    ),
    (
        (("*.nvm", r"\ANVM_V3"),),
        "A .nvm is a model of VisualSFM: export it as a Bundler file (bundle.out and list.txt), or use nerf poses.",
    ),
    (
        (("*.sens", ""),),
        "A .sens is a recording of ScanNet: unpack it with ScanNet's SensReader (color, pose, intrinsic).",
    ),
    (
        (("sfm_data*.bin", ""),),
        "It holds openMVG's sfm_data.bin: convert it to sfm_data.json (openMVG_main_ConvertSfM_DataFormat).",
    ),
    (
        (("*.abc", ""),),
        "If the .abc file is Meshroom's, convert it to sfm.json (the node ConvertSfMFormat).",
    ),
    (
        (("ARWorldMap*", ""),),
        "It looks like a recording of ARKit: convert it to a transforms.json (nerfstudio reads several such apps).",
    ),
    (
        (("*.json", '"(transform_matrix|file_path)"'),),
        "A transforms.json under another name is read with scene=transforms scene.file=NAME.",
    ),
    (
        (("*.psx", ""),),
        "A .psx is a project of Metashape: export its cameras as Agisoft XML (File > Export > Export Cameras).",
    ),
    ((("*.zip", ""),), "A zip archive is not read: unpack it, and give what it holds."),
    ((("*.glb", ""),), "A .glb is a finished model: give the photographs, or an export of its cameras."),
)
"""How to recognize captures of other programs that are not read, and what to do with them.

Each row: the signatures that a folder must have, all of them, and the advice. Formats that an extension reads are
listed in its reader.
"""
