"""The Blender format of the original method: `transforms_{train,val,test}.json` beside RGBA pictures."""

import logging
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np

from nerf_lightning.data.captures.capture import Capture, View, of_one_lens
from nerf_lightning.data.captures.checks import check_step, usable
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.captures.pictures import find_pictures
from nerf_lightning.data.captures.reader import cameras_of, decoded, require_fit
from nerf_lightning.data.captures.splits import MEMORISED, apart, every_kth
from nerf_lightning.data.pixels.decoding import upright_size
from nerf_lightning.data.pixels.images import ENDINGS, read_rgba
from nerf_lightning.data.pixels.plain_background import TOLERANCE
from nerf_lightning.data.pixels.store import read_pixels
from nerf_lightning.data.readers.base import GivenFrameReader
from nerf_lightning.data.readers.frames import FrameFile, say_of_files, views_of
from nerf_lightning.files.regular import what_is
from nerf_lightning.files.trust import reading
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.types.scene import LensModel, Scene

FORMAT = "The Blender format"
STEMS = ("transforms", "transform")
OF_PHOTOGRAPHS = ("fl_x", "fl_y", "k1", "k2", "p1", "p2", "camera_model", "aabb_scale")
"""Keys that renderings of the original format do not have."""
SPLITS = ("train", "val", "test")
HOLD_EVERY = 8

log = logging.getLogger(__name__)


@dataclass
class BlenderReader(GivenFrameReader):
    """Read a folder of the Blender format.

    If one of val and test is missing, the other serves as both; without either, every 8th train view is held out.

    Args:
        root: the folder with the JSON files.
        skip: per split, take every k-th frame, such as {"test": 8}, the usual short test; other splits are taken whole.
        metres_per_unit: length of a scene unit in meters, if known; null: unknown.
        allow_outside: follow names and links that lead out of root; false refuses them, because the capture may be
            untrusted.
    """

    named_by = (".json",)

    root: str
    skip: Mapping[str, int] | None = None
    metres_per_unit: float | None = None
    allow_outside: bool = False
    name: str = field(default="blender", kw_only=True)

    @classmethod
    def found_in(cls, folder: Path) -> str | None:
        """Return the file by which this format is known, where a folder has it."""
        path = _file_of(folder, "train")
        return None if path is None or _is_photographed(path) else path.name

    def read(self) -> Scene:
        """Return the capture: the views of train, val and test in this order.

        Raises:
            InputError: a setting that makes no sense, or anything wrong with the files.
        """
        self.check_settings()
        for split, step in (self.skip or {}).items():
            if split not in SPLITS:
                raise InputError(f"scene.skip names the split {split!r}; the splits are {listed(SPLITS)}.")
            check_step(f"skip.{split}", step)
        with reading(self.root):
            capture = self._capture()
        capture = usable(capture)
        capture, (width, height) = _of_one_size(capture)
        self.check_divisible(width, height)
        capture, pixels = decoded(
            capture,
            lambda views: read_pixels(
                [view.photograph.path for view in views],
                [(width, height)] * len(views),
                self.downscale,
                f"Reading {Path(self.root).name}",
            ),
        )
        capture.left_out.say(len(capture.views))
        assert capture.splits is not None
        paths = [view.photograph.path for view in capture.views]
        splits = dict(capture.splits)
        if not splits["train"]:
            raise InputError(f"{self.root} has no views to learn from. Export transforms_train.json again.")
        judged = "test" if splits["test"] else "val" if splits["val"] else f"every {HOLD_EVERY}th train view"
        if not splits["val"] and not splits["test"]:
            splits["train"], held = every_kth(splits["train"], HOLD_EVERY)
            splits |= {"val": held, "test": held}
            log.info("%s has no val or test split: every %dth train view is held out.", self.root, HOLD_EVERY)
        for missing, other in (("val", "test"), ("test", "val")):
            if not splits[missing]:
                splits[missing] = splits[other]
                count = len(splits[other])
                log.info("%s has no %s split: the %d %s views serve as it.", self.root, missing, count, other)
        files = [(width, height)] * len(paths)
        cameras = cameras_of(capture, files, pixels, self.downscale)
        learnt = {paths[view] for view in splits["train"]}
        remembered = MEMORISED if any(paths[view] in learnt for view in splits["test"]) else {}
        return self.scene(
            replace(cameras, c2w=cameras.c2w.float()),
            pixels,
            splits,
            [view.name for view in capture.views],
            {
                "filter": "none" if self.downscale == 1 else "area, premultiplied",
                "test_views": judged,
                "test_skip": str((self.skip or {}).get(judged, 1)),
            }
            | remembered,
            otherwise="white",
            metres_per_unit=self.metres_per_unit,
        )

    def _capture(self) -> Capture:
        """Return the views of train, val and test; a split without a file, or without frames, has none."""
        root = Path(self.root).expanduser()
        root = root.parent if os.path.isfile(root) else root
        if not os.path.isdir(root):
            raise InputError(f"The folder {root} {what_is(root)}. Set scene.root to the capture's folder.")
        files = {split: path for split in SPLITS if (path := _file_of(root, split))}
        files.setdefault("train", root / "transforms_train.json")  # whoever opens it says what is wrong
        read = {split: FrameFile.read(path, FORMAT) for split, path in files.items()}
        say_of_files(list(read.values()))
        left_out = LeftOut(str(files["train"]))
        views: dict[str, list[tuple[View, LensModel]]] = {split: [] for split in SPLITS}
        for split, file in read.items():
            skip = (self.skip or {}).get(split, 1)
            for found in views_of(file, root, self.allow_outside, left_out, skip):
                name = found.name.replace("\\", "/")
                name = (
                    Path(name).with_suffix("").as_posix() if name.lower().endswith(ENDINGS) else Path(name).as_posix()
                )
                views[split].append((replace(found.view, name=name), found.lens_model))
        left_out.require_enough(sum(map(len, views.values())))
        train, val, test = ([view.photograph.path for view, _ in views[split]] for split in SPLITS)
        kept = set(apart(train, val, test, lambda image: image.name, self.root))
        views["train"] = [each for each in views["train"] if each[0].photograph.path in kept]
        names = _shortest([(split, view.name) for split in SPLITS for view, _ in views[split]])
        every = list(chain(*views.values()))
        named = [replace(view, name=name) for (view, _), name in zip(every, names, strict=True)]
        numbers = iter(range(len(named)))
        splits = {split: tuple(next(numbers) for _ in views[split]) for split in SPLITS}
        capture = Capture(tuple(named), files["train"], splits=splits, left_out=left_out)
        return of_one_lens(capture, [kind for _, kind in every])


def _file_of(root: Path, split: str) -> Path | None:
    return next((path for stem in STEMS if (path := root / f"{stem}_{split}.json").is_file()), None)


def _is_photographed(path: Path) -> bool:
    """Tell whether a file lists photographs, as instant-ngp's do, and not renderings of the original format.

    Photographs have a lens, or opaque pictures without one color at all four corners.
    """
    file = FrameFile.read(path, FORMAT)
    first = file.frames[0] if file.frames and isinstance(file.frames[0], dict) else {}
    if any(key in {**file.content, **first} for key in OF_PHOTOGRAPHS):
        return True
    name = first.get("file_path")
    pictures = find_pictures([name], path.parent, path.parent, path, beside=()) if isinstance(name, str) else {}
    if not pictures:
        return False
    try:
        picture = read_rgba(pictures[str(name)])
    except InputError:
        return False
    corners = picture[:: picture.shape[0] - 1 or 1, :: picture.shape[1] - 1 or 1].reshape(-1, 4).astype(int)
    return bool((picture[..., 3] == 255).all() and np.ptp(corners, axis=0).max() > 2 * TOLERANCE)


def _of_one_size(capture: Capture) -> tuple[Capture, tuple[int, int]]:
    """Return the views whose images have the most frequent (width, height), and that size."""
    sizes = [upright_size(view.photograph) for view in capture.views]
    usual = Counter(sizes).most_common(1)[0][0]
    kept = []
    for number, (view, size) in enumerate(zip(capture.views, sizes, strict=True)):
        with capture.left_out.unless_usable(view.name):
            if size != usual:
                raise InputError(
                    f"The images of this format must all have one size. Most are {usual[0]} x {usual[1]}, but "
                    f"{view.photograph.path} is {size[0]} x {size[1]}. Render or resize it again."
                )
            require_fit(view, *size)
            kept.append(number)
    capture.left_out.require_enough(len(kept))
    return capture.some(kept), usual


def _shortest(views: list[tuple[str, str]]) -> list[str]:
    """Return the shortest names that tell (split, path) apart: stem, split/stem, the path, or split/path.

    >>> _shortest([("train", "a/r_0"), ("test", "b/r_0")])
    ['train/r_0', 'test/r_0']
    """
    stems = [Path(label).name for _, label in views]
    prefixed = [f"{split}/{stem}" for (split, _), stem in zip(views, stems, strict=True)]
    labels = [label for _, label in views]
    known = (names for names in (stems, prefixed, labels) if len(set(names)) == len(names))
    # One picture may serve in two splits.
    return next(known, [f"{split}/{label}" for split, label in views])
