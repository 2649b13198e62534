"""The base of all capture readers: turn a format's views into a scene in a working frame."""

import logging
import os
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.checks import check_metres, check_step, usable
from nerf_lightning.data.captures.fit_to_pictures import as_calibrated, cameras_of
from nerf_lightning.data.captures.folders import located, named_folder, require_one
from nerf_lightning.data.captures.mask_files import with_masks
from nerf_lightning.data.captures.scene import Coordinates, Spaces, check_extent, scene_of
from nerf_lightning.data.captures.splits import MEMORISED, every_kth, without_held_out
from nerf_lightning.data.pixels.decoded_photographs import read_photographs, upright_size
from nerf_lightning.data.pixels.masks import MaskColor
from nerf_lightning.data.pixels.plain_background import background_for, cut_out, protocol_of
from nerf_lightning.data.pixels.store import UndecodableError
from nerf_lightning.data.readers.base import Reader
from nerf_lightning.files.trust import reading
from nerf_lightning.messages.errors import InputError, require_one_of
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.poses import flip_yz
from nerf_lightning.nerf.types.scene import Background, PixelStore, Scene

OF_PANORAMAS = 3.2
"""Factor by which panoramas may be longer than photographs, as their pixels cover all directions."""

Axes = Literal["opengl", "opencv"]
Poses = Literal["c2w", "w2c"]

log = logging.getLogger(__name__)


@dataclass
class CaptureReader(Reader):
    """Read photographs with poses; a subclass defines its format.

    Args:
        root: the capture's folder.
        downscale: integer factor by which photographs are shrunk; focal lengths are scaled, too. auto: such that
            photographs are at most `longest`.
        longest: pixels of the longer side for downscale=auto. 640 are enough for a few minutes on a CPU; nerf train
            takes 1600 on a GPU.
        hold_every: the first and every k-th view after it are held out for evaluation, if the format names no split.
        frames: keep the views whose names fit this pattern of * and ?; null keeps all.
        masks: a folder below root with masks, named like their photographs (or with .png added, or instead of the
            extension); photographs without a mask are used whole. null: those that the format names, or else a folder
            masks with one per photograph. none: no masks.
        masks_keep: the color of masks that is kept, white or black; the other is ignored.
        space: bounded (a box around the content), ndc (forward-facing), contracted (all of space), or auto.
        axes: opengl, or opencv where the cameras in the files have axes right, down, forward although the format's are
            others; the doctor recognizes it.
        poses: c2w (camera to world), or w2c (world to camera) where the files have the inverse of the format's poses.
        coordinates: fitted (upright, centered, of a convenient size), or given: poses, near, far and the box are kept
            as in files or settings.
        near: distance at which content begins, in the capture's units; null: from the capture.
        far: distance at which content ends; null: from the capture.
        aabb_half: half the side of the box around the origin that holds the content, with coordinates=given; null: the
            capture's box.
        metres_per_unit: length of the capture's unit in meters, if known: depths are then in meters, and GLB files have
            their true size. Capture formats do not store it. null: unknown.
        cut_out: if opaque photographs show an object on a plain background, make that transparent.
        background: the background of transparent pixels and of rays that leave the scene: white, black, random or none.
            null: black (of the Blender format white); if a plain background was cut out, white_or_random,
            black_or_random or random, depending on its color.
        cache_dir: where decoded photographs are kept; null: the user's cache folder.
        allow_outside: follow names that lead out of root; false refuses them, because the capture may be untrusted.
            Links are always followed.
        verify: compare the contents of all files with the cache, not only their times.
        name: the scene's name in reports.
    """

    default_background: ClassVar[Background] = "black"
    """The format's default background."""

    root: str
    downscale: int | Literal["auto"] = 1
    longest: int = 640
    hold_every: int = 8
    frames: str | None = None
    masks: str | None = None
    masks_keep: MaskColor = "white"
    space: Spaces = "auto"
    axes: Axes = "opengl"
    poses: Poses = "c2w"
    coordinates: Coordinates = "fitted"
    near: float | None = None
    far: float | None = None
    aabb_half: float | None = None
    metres_per_unit: float | None = None
    cut_out: bool = True
    background: str | None = None
    cache_dir: str | None = None
    allow_outside: bool = False
    verify: bool = False
    name: str = "capture"

    @abstractmethod
    def capture(self) -> Capture:
        """Return the content of the files, before any pixel is read.

        Raises:
            InputError: anything wrong with the files.
        """

    def read(self) -> Scene:
        """Return the capture as a scene, in a working frame or its own.

        Raises:
            InputError: a setting makes no sense, or anything is wrong with the files.
        """
        self.check_settings()
        with reading(self.root):
            capture = as_meant(self.capture(), self.axes, self.poses)
        capture = self._wanted(capture)
        if capture.splits is None and len(capture.views) > 1:
            # Before views are left out, so that the others keep their splits.
            train, held = self.hold_out(range(len(capture.views)))
            capture = replace(capture, splits={"train": train, "val": held, "test": held})
        capture = as_calibrated(usable(capture))
        named = self.below(self.masks) if self.masks else None
        capture = with_masks(capture, self.masks, named, (self.top(), self.folder()), self.masks_keep)
        downscale = self._factor(capture)
        capture, pixels = self._decoded(capture, downscale)
        capture.left_out.say(len(capture.views))
        splits, judged_by = self._splits(capture)
        files = [upright_size(view.photograph) for view in capture.views]
        # Panoramas have no background, and a fisheye's picture has a dark rim.
        has_edge = capture.lens_model in ("pinhole", "radial_tangential")
        pixels, color = cut_out(pixels, self.name, self.cut_out and has_edge and self.background != "none")
        cameras = cameras_of(capture, files, pixels, downscale)
        protocol = {"downscale": str(downscale), "filter": "none" if downscale == 1 else "area, premultiplied"}
        protocol |= self.protocol(judged_by) | protocol_of(color)
        pictures = [(view.photograph.path, view.photograph.number) for view in capture.views]
        learnt = {pictures[view] for view in splits["train"]}
        remembered = MEMORISED if any(pictures[view] in learnt for view in splits["test"]) else {}
        return scene_of(
            capture,
            cameras,
            pixels,
            splits,
            name=self.name,
            space=self.space,
            near=self.near,
            far=self.far,
            background=background_for(self.background, color, self.default_background),
            protocol=protocol | remembered,
            metres_per_unit=self.metres_per_unit,
            coordinates=self.coordinates,
            aabb_half=self.aabb_half,
        )

    def hold_out(self, views: Sequence[int]) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the training views and the held-out views, if the format names no splits.

        Raises:
            InputError: one of the two would be empty.
        """
        if self.hold_every < 2:
            raise InputError(f"scene.hold_every={self.hold_every} would leave no training views: give 2 or more.")
        return every_kth(views, self.hold_every)

    def protocol(self, judged_by: str) -> dict[str, str]:
        """Return what measured numbers depend on, besides how the pixels were prepared.

        Args:
            judged_by: the split whose views are the test views, or how they were held out.
        """
        given = {"near": self.near, "far": self.far}
        said = {name: f"{value:g}" for name, value in given.items() if value is not None}
        return {"hold_every": str(self.hold_every), "frames": self.frames or "all"} | said

    def folder(self) -> Path:
        """Return the capture's folder: `root`, the only one just below it, or the one above it.

        Raises:
            InputError: there is no such folder, or there are several.
        """
        return self.found_folder

    @cached_property
    def found_folder(self) -> Path:
        """The result of `folder`, cached; callers that have already searched set it."""
        folder = named_folder(self.root)
        found = located(folder, lambda path: path if self.found_in(path) else None)
        require_one(found, self.root)
        if found and found[0] != folder:
            log.info("%s contains no capture for scene=%s; reading %s instead", self.root, type(self).name, found[0])
        return found[0] if found else folder

    def top(self) -> Path:
        """Return the folder that may contain pictures: the capture's, or the one above it that the user named."""
        named, folder = named_folder(self.root), self.folder()
        return named if folder.is_relative_to(named) else folder

    def below(self, name: str) -> Path:
        """Return the path that a setting names: below the folder that the user named, or below the capture's."""
        paths = [self.top() / name, self.folder() / name]
        return next(filter(os.path.lexists, paths), paths[-1])

    def _decoded(self, capture: Capture, downscale: int) -> tuple[Capture, PixelStore]:
        """Return the pixels, and the capture without the views whose photograph or mask cannot be decoded."""
        cache, label = Path(self.cache_dir) if self.cache_dir else None, f"Reading {Path(self.root).name}"
        while True:
            photographs = [
                replace(view.photograph, mask_keeps=view.photograph.mask_keeps or self.masks_keep)
                for view in capture.views
            ]
            try:
                return capture, read_photographs(photographs, downscale, cache, self.verify, label)
            except UndecodableError as error:
                names = [view.name for view in capture.views]
                capture.left_out.faults |= {names[number]: fault for number, fault in error.faults.items()}
                kept = [number for number in range(len(names)) if number not in error.faults]
                capture.left_out.require_enough(len(kept))
                capture = capture.some(kept)

    def _factor(self, capture: Capture) -> int:
        """Return the factor by which photographs shrink."""
        if self.downscale != "auto":
            return self.downscale
        longest = max(max(upright_size(view.photograph)) for view in capture.views)
        allowed = round(self.longest * (OF_PANORAMAS if capture.lens_model == "equirectangular" else 1.0))
        factor = -(-longest // allowed)
        if factor > 1:
            log.info("downscale: %d, of photographs of up to %d pixels (scene.downscale=1 keeps them)", factor, longest)
        return factor

    def check_settings(self) -> None:
        """Refuse settings that make no sense, before any file is read."""
        if self.downscale != "auto":
            check_step("downscale", self.downscale)
        check_step("longest", self.longest)
        require_one_of(get_args(MaskColor), **{"scene.masks_keep": self.masks_keep})
        require_one_of(get_args(Axes), **{"scene.axes": self.axes})
        require_one_of(get_args(Poses), **{"scene.poses": self.poses})
        check_metres(self.metres_per_unit)
        background_for(self.background, None, self.default_background)
        check_extent(self.space, self.near, self.far, self.coordinates, self.aabb_half)

    def _wanted(self, capture: Capture) -> Capture:
        """Return the views whose names match the pattern `frames`."""
        if self.frames is None:
            return capture
        faults = capture.left_out.faults
        capture.left_out.faults = {name: fault for name, fault in faults.items() if fnmatch(name, self.frames)}
        names = [view.name for view in capture.views]
        kept = [number for number, name in enumerate(names) if fnmatch(name, self.frames)]
        if not kept:
            raise InputError(
                f"scene.frames={self.frames!r} fits none of the views of {capture.source}; they are {listed(names, 5)}."
            )
        return capture.some(kept)

    def _splits(self, capture: Capture) -> tuple[dict[str, tuple[int, ...]], str]:
        """Return the splits, and what the test views are; see `protocol`."""
        given = capture.splits or {"train": tuple(range(len(capture.views)))}
        train, val, test = (given.get(split, ()) for split in ("train", "val", "test"))
        names = [view.name for view in capture.views]
        train = without_held_out(train, val, test, names.__getitem__, str(capture.source))
        if not train:
            raise InputError(
                f"{capture.source} lists no training view that exists. Fix its lists, or remove them so that "
                f"every {self.hold_every}th view is held out."
            )
        if not (val or test):
            log.warning(
                "%s lists no held-out view that exists: every %dth view is held out", capture.source, self.hold_every
            )
            train, held = self.hold_out(train)
            return {"train": train, "val": held, "test": held}, f"every {self.hold_every}th train view"
        for missing, other, views in (("val", "test", test), ("test", "val", val)):
            if not given.get(missing):
                log.info(
                    "%s has no %s split: the %d %s views serve as it", *(capture.source, missing, len(views), other)
                )
        return {"train": train, "val": val or test, "test": test or val}, "test" if test else "val"


def as_meant(capture: Capture, axes: Axes, poses: Poses) -> Capture:
    """Return a capture whose poses are converted to camera to world with axes right, up, back."""

    def turned(c2w: Float[Tensor, "3 4"]) -> Float[Tensor, "3 4"]:
        if poses == "w2c":
            c2w = torch.cat([c2w[:, :3].mT, -c2w[:, :3].mT @ c2w[:, 3:]], dim=1)
        return flip_yz(c2w) if axes == "opencv" else c2w

    return replace(capture, views=tuple(replace(view, c2w=turned(view.c2w)) for view in capture.views))
