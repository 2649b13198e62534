"""The Blender format of the original method: `transforms_{train,val,test}.json` next to RGBA pictures.

Near, far and the box: `conf/scene/blender.yaml`, too.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import ClassVar

from nerf_lightning.data.captures.capture import Capture, of_one_lens
from nerf_lightning.data.captures.checks import check_step
from nerf_lightning.data.captures.folders import named_folder
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.captures.scene import Coordinates
from nerf_lightning.data.captures.splits import without_held_out
from nerf_lightning.data.pixels.decoded_photographs import upright_size
from nerf_lightning.data.pixels.picture_files import ENDINGS
from nerf_lightning.data.readers.json_frames import FrameFile, say_of_files, views_of
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.types.scene import Background

FORMAT = "The Blender format"
STEMS = ("transforms", "transform")
SPLITS = ("train", "val", "test")


@dataclass
class BlenderReader(CaptureReader):
    """Read a folder of the Blender format. If one of val and test is missing, the other serves as both.

    Args:
        skip: per split, take every k-th frame, such as {"test": 8}, the usual short test; other splits are taken whole.
    """

    named_by = (".json",)
    default_background: ClassVar[Background] = "white"

    name: str = "blender"
    coordinates: Coordinates = "given"
    near: float | None = 2.0
    far: float | None = 6.0
    aabb_half: float | None = 1.5
    skip: Mapping[str, int] | None = None

    @classmethod
    def found_in(cls, folder: Path) -> str | None:
        """Return the file by which this format is recognized, if a folder has it."""
        path = _file_of(folder, "train")
        return None if path is None or FrameFile.read(path, FORMAT).is_photographed else path.name

    def folder(self) -> Path:
        """Return the capture's folder; if `root` has the files, their pictures are not examined."""
        named = named_folder(self.root)
        return named if _file_of(named, "train") else super().folder()

    def check_settings(self) -> None:
        """Refuse settings that make no sense, before any file is read."""
        super().check_settings()
        for split, step in (self.skip or {}).items():
            if split not in SPLITS:
                raise InputError(f"scene.skip names the split {split!r}; the splits are {listed(SPLITS)}.")
            check_step(f"skip.{split}", step)

    def protocol(self, judged_by: str) -> dict[str, str]:
        """Return what measured numbers depend on: which views are the test views, and how many of them are skipped."""
        frames = {} if self.frames is None else {"frames": self.frames}
        return {"test_views": judged_by, "test_skip": str((self.skip or {}).get(judged_by, 1))} | frames

    def capture(self) -> Capture:
        """Return the views of train, val and test, in this order; a split may be empty."""
        root = self.folder()
        files = {split: path for split in SPLITS if (path := _file_of(root, split))}
        files.setdefault("train", root / "transforms_train.json")  # opening it reports what is wrong
        read = {split: FrameFile.read(path, FORMAT) for split, path in files.items()}
        say_of_files(list(read.values()))
        left_out, every = LeftOut(str(files["train"])), self.skip or {}
        found = [
            (split, frame)
            for split, file in read.items()
            for frame in views_of(file, self.top(), self.allow_outside, left_out, every.get(split, 1))
        ]
        left_out.require_enough(len(found))
        train, val, test = ([frame.view.photograph.path for of, frame in found if of == split] for split in SPLITS)
        learnt = set(without_held_out(train, val, test, lambda path: path.name, self.root))
        found = [(of, frame) for of, frame in found if of != "train" or frame.view.photograph.path in learnt]
        names = _shortest([(split, frame.name) for split, frame in found])
        views = tuple(replace(frame.view, name=name) for (_, frame), name in zip(found, names, strict=True))
        splits = {split: tuple(n for n, (of, _) in enumerate(found) if of == split) for split in SPLITS}
        capture = Capture(views, files["train"], splits=splits, left_out=left_out)
        return _of_one_size(of_one_lens(capture, [frame.lens_model for _, frame in found]))


def _file_of(root: Path, split: str) -> Path | None:
    return next((path for stem in STEMS if (path := root / f"{stem}_{split}.json").is_file()), None)


def _of_one_size(capture: Capture) -> Capture:
    """Return the views whose pictures have the most frequent (width, height): others were rendered separately."""
    sizes = [upright_size(view.photograph) for view in capture.views]
    usual = max(count := Counter(sizes), key=count.__getitem__, default=(0, 0))
    for view, size in zip(capture.views, sizes, strict=True):
        if size != usual:
            capture.left_out.faults[view.name] = (
                f"The images of this format must all have one size. Most are {usual[0]} x {usual[1]}, but "
                f"{view.photograph.path} is {size[0]} x {size[1]}. Render or resize it again."
            )
    kept = [number for number, size in enumerate(sizes) if size == usual]
    capture.left_out.require_enough(len(kept))
    return capture.some(kept)


def _shortest(views: list[tuple[str, str]]) -> list[str]:
    """Return the shortest names that distinguish (split, path): stem, split/stem, the path, or split/path.

    >>> _shortest([("train", "./a/r_0.png"), ("test", "b/r_0")])
    ['train/r_0', 'test/r_0']
    """
    paths = [PurePosixPath(path.replace("\\", "/")) for _, path in views]
    paths = [path.with_suffix("") if path.suffix.lower() in ENDINGS else path for path in paths]
    prefixed = [f"{split}/{path.name}" for (split, _), path in zip(views, paths, strict=True)]
    known = (
        names for names in ([path.name for path in paths], prefixed, [*map(str, paths)]) if len({*names}) == len(names)
    )
    # One picture may serve in two splits.
    return next(known, [f"{split}/{path}" for (split, _), path in zip(views, paths, strict=True)])
