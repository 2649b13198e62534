"""The Blender format of the original method: `transforms_{train,val,test}.json` beside RGBA pictures."""

import logging
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.data.captures.checks import (
    WIDEST,
    box_around_origin,
    check_bounds,
    check_divisible,
    check_metres,
    check_present,
    check_step,
    contents,
    one_size,
    pose_from_matrix,
    require_different,
)
from nerf_lightning.data.captures.splits import MEMORISED, apart, every_kth
from nerf_lightning.data.pixels.images import ENDINGS, image_size
from nerf_lightning.data.pixels.plain_background import background_for, cut_out, protocol_of
from nerf_lightning.data.pixels.store import read_pixels
from nerf_lightning.data.readers.base import Reader
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.json_files import keys_of, read_json
from nerf_lightning.files.links import require_inside
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed, require_printable
from nerf_lightning.nerf.geometry.cameras import focal_from_fov, pinhole_cameras
from nerf_lightning.nerf.types.scene import Cameras, Scene

FORMAT = "The Blender format"
LEAST_ANGLE = 1e-6
KEYS, FRAME_KEYS = ("camera_angle_x", "frames"), ("file_path", "transform_matrix")


@dataclass(frozen=True)
class Frame:
    """One view as the file names it."""

    image: Path
    label: str
    """`file_path` without a leading `./` and without its ending."""
    c2w: Float[Tensor, "3 4"]
    fov: float
    """Horizontal angle of view in radians."""


def read_frames(path: Path, step: int = 1) -> list[Frame]:
    """Return every `step`-th frame of a transforms file; its images lie relative to the file's folder.

    Raises:
        InputError: not json, lacks keys, has a matrix that is no pose, or names images that do not exist.
    """
    content = read_json(path)
    fov, entries = keys_of(content, KEYS, str(path), FORMAT)
    if isinstance(fov, bool) or not isinstance(fov, int | float) or not LEAST_ANGLE <= fov <= math.radians(WIDEST):
        raise InputError(
            f"{path}: camera_angle_x is {fov!r}, but it must be an angle between 0 and {math.radians(WIDEST):.2f} "
            f"radians (the horizontal angle of view; no perspective lens has more than {WIDEST:g} degrees)."
        )
    if not isinstance(entries, list):
        raise InputError(f"{path}: frames must be a list of views, but it is {type(entries).__name__}.")
    require_within("views", len(entries), str(path), "views")
    frames = [_frame(path, index, entries[index], float(fov)) for index in range(0, len(entries), step)]
    check_present((frame.image for frame in frames), path)
    return frames


def _frame(path: Path, index: int, entry: object, fov: float) -> Frame:
    """Return one checked frame."""
    where = f"{path}: frames[{index}]"
    name, matrix = keys_of(entry, FRAME_KEYS, where, FORMAT)
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}: file_path is {name!r}, but it must be the image's path as text.")
    require_printable(name, where)
    # Only known endings count: the original files leave ".png" out, and a name may hold a dot of its own.
    image = Path(name) if name.lower().endswith(ENDINGS) else Path(name + ".png")
    return Frame(
        image=path.parent / image,
        label=image.with_suffix("").as_posix(),
        c2w=pose_from_matrix(matrix, f"{where} ({name}): transform_matrix"),
        fov=fov,
    )


SPLITS = ("train", "val", "test")
HOLD_EVERY = 8

log = logging.getLogger(__name__)


class BlenderReader(Reader):
    """Read a folder of the Blender format.

    A missing val split is held out from train, every 8th view. A missing test split is judged on val.

    Args:
        root: the folder with the json files.
        near: distance along every ray at which content may begin, scene units.
        far: distance at which content ends.
        background: what the transparent pixels lie on: white, black, random or none. null: white; where a plain
            background was cut out, white_or_random, black_or_random or random, as its colour is.
        cut_out: where opaque pictures show a thing before one plain colour, make that transparent.
        downscale: whole factor by which the pictures shrink (premultiplied area filter); the focal follows.
        skip: per split, take every k-th frame, such as {"test": 8}, the usual short test; splits not named are
            taken whole.
        metres_per_unit: how many metres a scene unit is long, where it is known; null: unknown.
        aabb_half: half the side of the box around the origin that holds the content, scene units.
        allow_outside: follow names and links that lead out of root; false refuses them, since they may be a stranger's.
        name: what the scene is called in reports.
    """

    def __init__(
        self,
        root: str,
        near: float = 2.0,
        far: float = 6.0,
        background: str | None = None,
        cut_out: bool = True,
        downscale: int = 1,
        skip: Mapping[str, int] | None = None,
        metres_per_unit: float | None = None,
        aabb_half: float = 1.5,
        allow_outside: bool = False,
        name: str = "blender",
    ) -> None:
        self.root = Path(root)
        self.near = near
        self.far = far
        self.background = background
        self.cut_out = cut_out
        self.downscale = downscale
        self.skip = dict(skip or {})
        self.metres_per_unit = metres_per_unit
        self.aabb_half = aabb_half
        self.allow_outside = allow_outside
        self.name = name

    def read(self) -> Scene:
        """Return the capture: the views of train, val and test in this order.

        Raises:
            InputError: a setting that makes no sense, or anything wrong with the files.
        """
        self._check_settings()
        frames = self._frames()
        views = [frame for split in SPLITS for frame in frames[split]]
        sizes = {frame.image: image_size(frame.image) for frame in views}
        width, height = one_size(sizes)
        check_divisible(width, height, self.downscale)
        splits = _splits({split: len(frames[split]) for split in SPLITS}, self.root)
        label = f"Reading {self.root.name}"
        pixels = read_pixels([frame.image for frame in views], [(width, height)] * len(views), self.downscale, label)
        pixels, color = cut_out(pixels, self.name, self.cut_out and self.background != "none")
        return Scene(
            name=self.name,
            cameras=_cameras(views, width // self.downscale, height // self.downscale),
            pixels=pixels,
            near=torch.full((len(views),), float(self.near)),
            far=torch.full((len(views),), float(self.far)),
            aabb=box_around_origin(self.aabb_half),
            splits=splits,
            view_names=_names(frames),
            background=background_for(self.background, color, "white"),
            to_user=torch.eye(4),
            metres_per_unit=self.metres_per_unit,
            protocol=self._protocol(frames) | protocol_of(color),
            truth=None,
        )

    def _check_settings(self) -> None:
        """Refuse settings that make no sense before any file is read."""
        check_step("downscale", self.downscale)
        check_metres(self.metres_per_unit)
        for split, step in self.skip.items():
            if split not in SPLITS:
                raise InputError(f"scene.skip names the split {split!r}; the splits are {listed(SPLITS)}.")
            check_step(f"skip.{split}", step)
        check_bounds(self.near, self.far)
        background_for(self.background, None, "white")
        box_around_origin(self.aabb_half)

    def _frames(self) -> dict[str, list[Frame]]:
        """Return the frames of each split; a split without a file, or without frames, is an empty list."""
        if not os.path.isdir(self.root):
            raise InputError(f"The folder {self.root} does not exist. Set scene.root to the capture's folder.")
        files = {split: self.root / f"transforms_{split}.json" for split in SPLITS}
        if not files["train"].is_file():
            raise InputError(
                f"{files['train']} does not exist; the folder holds {contents(self.root)}. "
                "Set scene.root to the folder that holds transforms_train.json."
            )
        frames = {
            split: read_frames(path, self.skip.get(split, 1)) if path.is_file() else [] for split, path in files.items()
        }
        if not self.allow_outside:
            for path in (*files.values(), *(frame.image for split in frames.values() for frame in split)):
                require_inside(path, self.root)
        for split, named in frames.items():
            require_different((frame.label for frame in named), str(files[split]))
        if not frames["train"]:
            raise InputError(f"{files['train']} has no frames, so there is nothing to learn from. Export it again.")
        train, val, test = ([frame.image for frame in frames[split]] for split in SPLITS)
        kept = set(apart(train, val, test, lambda image: image.name, str(self.root)))
        return frames | {"train": [frame for frame in frames["train"] if frame.image in kept]}

    def _protocol(self, frames: Mapping[str, list[Frame]]) -> dict[str, str]:
        """Say how the pixels were made and which views are judged."""
        judged = "test" if frames["test"] else "val" if frames["val"] else f"every {HOLD_EVERY}th train view"
        learnt = {frame.image for frame in frames["train"]}
        remembered = MEMORISED if any(frame.image in learnt for frame in frames["test"]) else {}
        return {
            "downscale": str(self.downscale),
            "filter": "none" if self.downscale == 1 else "area, premultiplied",
            "test_views": judged,
            "test_skip": str(self.skip.get(judged, 1)),
        } | remembered


def _cameras(views: list[Frame], width: int, height: int) -> Cameras:
    """Return the cameras at the size of the kept pixels; each file has its own angle of view."""
    c2w = torch.stack([frame.c2w for frame in views]).float()
    focal = torch.tensor([focal_from_fov(width, frame.fov) for frame in views])
    return replace(pinhole_cameras(c2w, 1.0, width, height), focal=focal[:, None].repeat(1, 2))


def _splits(counts: Mapping[str, int], root: Path) -> dict[str, tuple[int, ...]]:
    """Number the views split after split, and hold views out where val or test is missing."""
    bounds = [0, counts["train"], counts["train"] + counts["val"], sum(counts.values())]
    train, val, test = (tuple(range(*pair)) for pair in pairwise(bounds))
    if not val:
        train, val = every_kth(train, HOLD_EVERY)
        log.info("%s has no val split: every %dth train view is held out for it.", root, HOLD_EVERY)
    if not test:
        test = val
        log.info("%s has no test split: the %d val views serve as test.", root, len(val))
    return {"train": train, "val": val, "test": test}


def _names(frames: Mapping[str, list[Frame]]) -> tuple[str, ...]:
    """Return the shortest names that tell the views apart: stem, split/stem, the path in the json, or split/path."""
    views = [(split, frame.label) for split in SPLITS for frame in frames[split]]
    stems = [Path(label).name for _, label in views]
    prefixed = [f"{split}/{Path(label).name}" for split, label in views]
    for names in (stems, prefixed):
        if len(set(names)) == len(names):
            return tuple(names)
    labels = tuple(label for _, label in views)
    # One picture may serve in two splits.
    return labels if len(set(labels)) == len(labels) else tuple(f"{split}/{label}" for split, label in views)
