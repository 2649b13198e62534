"""The Blender format of the original method: `transforms_{train,val,test}.json` beside RGBA pictures."""

import logging
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.data.captures.capture import Capture, View
from nerf_lightning.data.captures.checks import check_step, contents, pose_from_matrix, usable
from nerf_lightning.data.captures.splits import MEMORISED, apart, every_kth
from nerf_lightning.data.pixels.decoding import Photograph
from nerf_lightning.data.pixels.images import ENDINGS, image_size
from nerf_lightning.data.pixels.store import read_pixels
from nerf_lightning.data.readers.base import GivenFrameReader
from nerf_lightning.data.readers.frames import focal_of_angle, list_of_frames, path_of
from nerf_lightning.files.json_files import keys_of, read_json
from nerf_lightning.files.links import is_there, require_inside
from nerf_lightning.files.trust import reading
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.cameras import pinhole_cameras
from nerf_lightning.nerf.types.scene import Scene

FORMAT = "The Blender format"
SPLITS = ("train", "val", "test")
HOLD_EVERY = 8

log = logging.getLogger(__name__)


@dataclass
class BlenderReader(GivenFrameReader):
    """Read a folder of the Blender format.

    A missing val split is held out from train, every 8th view. A missing test split is judged on val.

    Args:
        root: the folder with the json files.
        skip: per split, take every k-th frame, such as {"test": 8}, the usual short test; splits not named are
            taken whole.
        metres_per_unit: how many metres a scene unit is long, where it is known; null: unknown.
        allow_outside: follow names and links that lead out of root; false refuses them, since they may be a stranger's.
    """

    root: str
    skip: Mapping[str, int] | None = None
    metres_per_unit: float | None = None
    allow_outside: bool = False
    name: str = field(default="blender", kw_only=True)

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
        assert capture.splits is not None
        paths = [view.photograph.path for view in capture.views]
        width, height = _one_size(capture)
        self.check_divisible(width, height)
        splits = dict(capture.splits)
        if not splits["train"]:
            raise InputError(f"{self.root} has no views to learn from. Export transforms_train.json again.")
        judged = "test" if splits["test"] else "val" if splits["val"] else f"every {HOLD_EVERY}th train view"
        if not splits["val"]:
            splits["train"], splits["val"] = every_kth(splits["train"], HOLD_EVERY)
            log.info("%s has no val split: every %dth train view is held out for it.", self.root, HOLD_EVERY)
        if not splits["test"]:
            splits["test"] = splits["val"]
            log.info("%s has no test split: the %d val views serve as test.", self.root, len(splits["val"]))
        pixels = read_pixels(paths, [(width, height)] * len(paths), self.downscale, f"Reading {Path(self.root).name}")
        c2w = torch.stack([view.c2w for view in capture.views]).float()
        focal = torch.tensor([[view.focal[0] / self.downscale] * 2 for view in capture.views])
        cameras = pinhole_cameras(c2w, 1.0, width // self.downscale, height // self.downscale)
        learnt = {paths[view] for view in splits["train"]}
        remembered = MEMORISED if any(paths[view] in learnt for view in splits["test"]) else {}
        return self.scene(
            replace(cameras, focal=focal),
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
        root = Path(self.root)
        if not os.path.isdir(root):
            raise InputError(f"The folder {root} does not exist. Set scene.root to the capture's folder.")
        files = {split: root / f"transforms_{split}.json" for split in SPLITS}
        if not files["train"].is_file():
            raise InputError(
                f"{files['train']} does not exist; the folder holds {contents(root)}. "
                "Set scene.root to the folder that holds transforms_train.json."
            )
        views = {split: self._views(path, split) if path.is_file() else [] for split, path in files.items()}
        train, val, test = ([view.photograph.path for view in views[split]] for split in SPLITS)
        kept = set(apart(train, val, test, lambda image: image.name, self.root))
        views["train"] = [view for view in views["train"] if view.photograph.path in kept]
        names = _shortest([(split, view.name) for split in SPLITS for view in views[split]])
        named = [replace(view, name=name) for view, name in zip(chain(*views.values()), names, strict=True)]
        numbers = iter(range(len(named)))
        splits = {split: tuple(next(numbers) for _ in views[split]) for split in SPLITS}
        return Capture(views=tuple(named), source=root, splits=splits)

    def _views(self, path: Path, split: str) -> list[View]:
        """Return the views of a file, whose images lie relative to its folder; their names are the file's."""
        content = read_json(path)
        _, entries = keys_of(content, ("camera_angle_x", "frames"), str(path), FORMAT)
        found: list[tuple[Path, str, Float[Tensor, "3 4"]]] = []
        for index, entry in list(enumerate(list_of_frames(entries, path)))[:: (self.skip or {}).get(split, 1)]:
            where = f"{path}: frames[{index}]"
            name, matrix = keys_of(entry, ("file_path", "transform_matrix"), where, FORMAT)
            # Only known endings count: the original files leave ".png" out, and a name may hold a dot of its own.
            name = path_of(name, "file_path", where)
            image = Path(name if name.lower().endswith(ENDINGS) else name + ".png")
            pose = pose_from_matrix(matrix, f"{where} ({name}): transform_matrix")
            found.append((path.parent / image, image.with_suffix("").as_posix(), pose))
        absent = [image for image, _, _ in found if not is_there(image)]
        if absent:
            raise InputError(
                f"{path} names {len(absent)} image(s) that do not exist: {listed(absent)}. Copy them there, "
                "or remove their frames from the file."
            )
        if not self.allow_outside:
            for inner in (path, *(image for image, _, _ in found)):
                require_inside(inner, Path(self.root))
        views = []
        for image, name, c2w in found:
            width, height = map(float, image_size(image))
            focal = focal_of_angle(content, "x", width, str(path))
            views.append(View(name, Photograph(image), c2w, (focal, focal), (width / 2, height / 2), (width, height)))
        return views


def _one_size(capture: Capture) -> tuple[int, int]:
    """Return the (width, height) that all images share, or refuse those that differ from the most frequent one."""
    usual = Counter(view.size for view in capture.views).most_common(1)[0][0]
    odd = [f"{v.photograph.path} ({v.size[0]:g} x {v.size[1]:g})" for v in capture.views if v.size != usual]
    if odd:
        raise InputError(
            f"The images of this format must all have one size. Most are {usual[0]:g} x {usual[1]:g}, but not "
            f"{listed(odd)}. Render or resize these again, or remove their frames."
        )
    return int(usual[0]), int(usual[1])


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
