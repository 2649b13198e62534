"""What all captures share: from a format's views to a scene in a working frame."""

import logging
import math
import os
from abc import abstractmethod
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Literal, get_args

import torch
from torch import Tensor

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.checks import FARTHEST, LEAST_FOCAL, check_metres, check_step, usable
from nerf_lightning.data.captures.extent import choose_space, extent_of, require_possible
from nerf_lightning.data.captures.known_depths import known_depths
from nerf_lightning.data.captures.splits import MEMORISED, apart, every_kth
from nerf_lightning.data.pixels.decoding import read_photographs
from nerf_lightning.data.pixels.images import ENDINGS, MaskColor, downscaled_size, image_size
from nerf_lightning.data.pixels.plain_background import background_for, cut_out, protocol_of
from nerf_lightning.data.readers.base import Reader
from nerf_lightning.files.links import is_there, require_inside
from nerf_lightning.files.trust import reading
from nerf_lightning.files.walk import walk
from nerf_lightning.messages.errors import InputError, require_one_of
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.frames import points_from_user, poses_from_user, unit_of
from nerf_lightning.nerf.geometry.lens_checks import require_invertible
from nerf_lightning.nerf.types.scene import Cameras, PixelStore, Scene

Spaces = Literal["auto", "bounded", "ndc", "contracted"]
LARGEST_STRETCH = 0.01
"""Of width and height: how far a picture's scale may differ from one axis to the other."""

log = logging.getLogger(__name__)


@dataclass
class CaptureReader(Reader):
    """Read photographs with poses; a subclass says what its format holds.

    Args:
        root: the capture's folder.
        downscale: whole factor by which the photographs shrink; focal lengths follow.
        hold_every: the first and every k-th view after it are held out to judge by, where the format names no split.
        frames: keep the views whose names fit this pattern of * and ?; null keeps all.
        masks: a folder below root with a mask for each photograph, of the same name below it (or with .png added, or
            with .png for its ending). null: no masks, or those that the format names.
        masks_keep: the colour of masks that counts, white or black; the other is left out.
        space: bounded (a box around the content), ndc (forward-facing), contracted (all of space), or auto.
        near: distance at which content may begin, in the user's units; null: from the capture.
        far: distance at which content ends; null: from the capture.
        metres_per_unit: how many metres a unit of the capture's frame is long, where it is known: then depths are told
            in metres, and GLB files have their true size. No format of captures says it. null: unknown.
        cut_out: where opaque photographs show a thing before one plain colour, make that transparent.
        background: what lies behind transparent pixels or the end of the scene: white, black, random or none. null:
            black; where a plain background was cut out, white_or_random, black_or_random or random, as its colour is.
        cache_dir: where decoded photographs are kept; null: the user's cache folder.
        allow_outside: follow names and links that lead out of root; false refuses them, since they may be a stranger's.
        verify: compare the contents of all files with what was decoded, not their times alone.
        name: the scene's name in reports.
    """

    root: str
    downscale: int = 1
    hold_every: int = 8
    frames: str | None = None
    masks: str | None = None
    masks_keep: MaskColor = "white"
    space: Spaces = "auto"
    near: float | None = None
    far: float | None = None
    metres_per_unit: float | None = None
    cut_out: bool = True
    background: str | None = None
    cache_dir: str | None = None
    allow_outside: bool = False
    verify: bool = False
    name: str = "capture"

    @abstractmethod
    def capture(self) -> Capture:
        """Return what the format says, before any pixel is read.

        Raises:
            InputError: anything wrong with the files.
        """

    def read(self) -> Scene:
        """Return the capture as a scene in a working frame: upright, centred, of a handy size.

        Raises:
            InputError: a setting that makes no sense, or anything wrong with the files.
        """
        self._check_settings()
        with reading(self.root):
            capture = self.capture()
        capture = usable(self._wanted(capture))
        splits = self._splits(capture)
        if self.masks_keep == "black" and not any(view.photograph.mask for view in capture.views):
            raise InputError(
                f"scene.masks_keep=black, and no photograph of {capture.source} has a mask. Say where they are with "
                "scene.masks=FOLDER, or leave masks_keep out."
            )
        files = [image_size(view.photograph.path) for view in capture.views]
        pixels = read_photographs(
            [replace(view.photograph, mask_keeps=self.masks_keep) for view in capture.views],
            self.downscale,
            Path(self.cache_dir) if self.cache_dir else None,
            self.verify,
            f"Reading {Path(self.root).name}",
        )
        # Panoramas have no background, and a fisheye's picture has a dark rim.
        has_edge = capture.lens_model in ("pinhole", "radial_tangential")
        pixels, color = cut_out(pixels, self.name, self.cut_out and has_edge and self.background != "none")
        cameras = cameras_of(capture, files, pixels, self.downscale)
        names = tuple(view.name for view in capture.views)
        require_invertible(cameras, names)
        space, reason = choose_space(self.space, cameras, capture, pixels.has_transparency)
        log.info("%s: space=%s, %s", self.name, space, reason)
        if capture.left_out:
            log.warning(
                "%d photographs have no pose and are left out: %s", len(capture.left_out), listed(capture.left_out, 5)
            )
        protocol = {
            "downscale": str(self.downscale),
            "filter": "none" if self.downscale == 1 else "area, premultiplied",
            "hold_every": str(self.hold_every),
            "frames": self.frames or "all",
        }
        remembered = MEMORISED if set(splits["train"]) & set(splits["test"]) else {}
        extent = extent_of(capture, cameras, space, self.near, self.far)
        to_user = (capture.undo @ extent.to_user).float()
        depths = known_depths(capture, cameras)
        if depths is not None:
            depths = replace(depths, distance=(depths.distance / unit_of(extent.to_user)).float())
        require_possible(extent, to_user, capture)
        return Scene(
            name=self.name,
            cameras=replace(cameras, c2w=poses_from_user(cameras.c2w, extent.to_user).float(), ndc=extent.ndc),
            pixels=pixels,
            near=extent.near,
            far=extent.far,
            aabb=extent.aabb,
            splits=splits,
            view_names=names,
            background=background_for(self.background, color, "black"),
            space=space,
            depths=depths,
            points=points_from_user(capture.points, extent.to_user).float(),
            to_user=to_user,
            metres_per_unit=self.metres_per_unit,
            protocol=protocol | protocol_of(color) | remembered,
            truth=None,
            left_out=capture.left_out,
        )

    def folder(self) -> Path:
        """Return the capture's folder, which must exist."""
        try:
            folder = Path(self.root).expanduser()
        except RuntimeError as error:
            raise InputError(f"scene.root={self.root}: {error}. Give the folder without ~.") from error
        if not os.path.isdir(folder):
            where = "" if folder.is_absolute() else f" in {Path.cwd()}, where relative ones are looked for"
            raise InputError(f"The folder {folder} does not exist{where}. Set scene.root to the capture's folder.")
        return folder

    def require_inside(self, path: Path, setting: str | None = None) -> None:
        """Refuse what is really outside of the capture's folder and of the one that a setting names, unless allowed."""
        if not self.allow_outside:
            require_inside(path, self.folder(), setting)

    def mask_of(self, name: str) -> Path | None:
        """Return the mask of the photograph `name`, where masks are used; then each must have one."""
        if self.masks is None:
            return None
        beside = self.folder() / self.masks / name
        candidates = (beside, beside.with_name(beside.name + ".png"), beside.with_suffix(".png"))
        for candidate in candidates:
            if is_there(candidate):
                self.require_inside(candidate, self.masks)
                return candidate
        raise InputError(
            f"scene.masks={self.masks} holds no mask for {name}: neither {listed(candidates)} exists. Add it "
            f"(all {self.masks_keep} keeps the whole photograph), or leave the view out with scene.frames."
        )

    def _check_settings(self) -> None:
        check_step("downscale", self.downscale)
        if self.hold_every < 2:
            raise InputError(f"scene.hold_every={self.hold_every} would leave nothing to learn from: give 2 or more.")
        if self.space not in get_args(Spaces):
            raise InputError(f"scene.space={self.space!r}: choose one of {', '.join(get_args(Spaces))}.")
        require_one_of(get_args(MaskColor), **{"scene.masks_keep": self.masks_keep})
        check_metres(self.metres_per_unit)
        background_for(self.background, None, "black")
        near, far = self.near, self.far
        if not 0.0 <= (near or 0.0) < math.inf or not (near or 0.0) < (math.inf if far is None else far):
            raise InputError(
                f"scene.near={near} and scene.far={far}: rays need 0 <= near < far, in the capture's units."
            )

    def _wanted(self, capture: Capture) -> Capture:
        """Return the views whose names fit the pattern `frames`."""
        if self.frames is None:
            return capture
        names = [view.name for view in capture.views]
        kept = [number for number, name in enumerate(names) if fnmatch(name, self.frames)]
        if not kept:
            raise InputError(
                f"scene.frames={self.frames!r} fits none of the views of {capture.source}; they are {listed(names, 5)}."
            )
        return capture.some(kept)

    def _splits(self, capture: Capture) -> dict[str, tuple[int, ...]]:
        if capture.splits is None:
            train, held = every_kth(range(len(capture.views)), self.hold_every)
            return {"train": train, "val": held, "test": held}
        splits = {split: tuple(capture.splits.get(split, ())) for split in ("train", "val", "test")}
        names = [view.name for view in capture.views]
        splits["train"] = apart(splits["train"], splits["val"], splits["test"], names.__getitem__, str(capture.source))
        held = splits["val"] or splits["test"]
        if not splits["train"] or not held:
            raise InputError(
                f"{capture.source} splits its views into {len(splits['train'])} to learn from and {len(held)} to judge "
                "by; each needs at least one. Mend its lists, or remove them so that every "
                f"{self.hold_every}th view is held out."
            )
        return {"train": splits["train"], "val": held, "test": splits["test"] or held}


def cameras_of(capture: Capture, files: list[tuple[int, int]], pixels: PixelStore, downscale: int) -> Cameras:
    """Return the cameras at the size of the pixels that were read.

    The intrinsics hold for the sizes that the format names, `files` are (width, height) of each picture file, and what
    `downscale` leaves over was cropped at the right and the bottom.

    Raises:
        InputError: a picture is not a shrunk copy of what its camera describes, or the pixels are another capture's.
    """
    sizes = [downscaled_size(width, height, downscale) for width, height in files]
    if sizes != list(zip(pixels.width.tolist(), pixels.height.tolist(), strict=True)):
        raise InputError(
            f"The pixels that were kept of {capture.source} have other sizes than its photographs: somebody else wrote "
            "them. Remove them from scene.cache_dir (else ~/.cache/nerf_lightning), and the photographs are read anew."
        )

    def column(name: str) -> Tensor:
        return torch.tensor([getattr(view, name) for view in capture.views], dtype=torch.float64)

    scales = []
    for view, (width, height) in zip(capture.views, files, strict=True):
        x, y = width / view.size[0], height / view.size[1]
        # A shrunk picture's size is rounded: allow a pixel on either side.
        slack = LARGEST_STRETCH + 1.0 / min(width, height)
        if abs(x / y - 1.0) > slack:
            raise InputError(
                f"{view.photograph.path} has {width} x {height} pixels, but its camera was calibrated for "
                f"{view.size[0]:g} x {view.size[1]:g}: the sides differ by other factors ({x:.3f} and {y:.3f}). The "
                "picture was cropped, turned or stretched after the poses were estimated; use the original one."
            )
        scales.append((x / downscale, y / downscale))
    scale = torch.tensor(scales, dtype=torch.float64)
    focal = column("focal") * scale
    possible = ((focal >= LEAST_FOCAL) & (focal <= FARTHEST)).all(dim=-1)
    if not bool(possible.all()):
        view = capture.views[possible.tolist().index(False)]
        raise InputError(
            f"{capture.source}: the view {view.name} has a focal length of {view.focal[0]:g}, {view.focal[1]:g} pixels "
            f"of {view.size[0]:g} x {view.size[1]:g}, which no lens has on the picture that is there. Export it again."
        )
    return Cameras(
        c2w=torch.stack([view.c2w for view in capture.views]),
        focal=focal.float(),
        center=(column("center") * scale).float(),
        lens=column("lens").float(),
        lens_model=capture.lens_model,
        width=pixels.width,
        height=pixels.height,
    )


def picture_files(folder: Path) -> list[str]:
    """Return the names of the pictures in a folder and its subfolders, sorted as text."""
    found = []
    for base, _, names in walk(folder):
        found += [(base / name).relative_to(folder).as_posix() for name in names if name.lower().endswith(ENDINGS)]
    return sorted(name for name in found if not Path(name).name.startswith("."))
