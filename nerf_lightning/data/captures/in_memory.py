"""A scene of images and cameras that are in memory already."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from nerf_lightning.data.captures.capture import Capture, View
from nerf_lightning.data.captures.checks import usable
from nerf_lightning.data.captures.fit_to_pictures import cameras_of
from nerf_lightning.data.captures.left_out import LeftOut
from nerf_lightning.data.captures.scene import Spaces, check_extent, scene_of
from nerf_lightning.data.pixels.decoded_photographs import Photograph
from nerf_lightning.data.pixels.plain_background import background_for
from nerf_lightning.data.pixels.store import empty_store
from nerf_lightning.data.readers.base import Reader
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import Cameras, PixelStore, Scene

SOURCE = "scene_from_cameras"


class InMemoryReader(Reader):
    """Placeholder in the config of a run whose scene was given from Python.

    Args:
        name: of the scene.
    """

    def __init__(self, name: str):
        self.name = name

    def read(self) -> Scene:
        """Refuse: the images are not in a file.

        Raises:
            InputError: always.
        """
        raise InputError(
            f"The images of {self.name} were given from Python (scene=in_memory) and are in no file. Give them again, "
            "as in nl.train(..., scene=scene) and nl.build_run(..., scene=scene), or name a capture: scene=..."
        )


def scene_from_cameras(
    images: Any,
    cameras: Cameras,
    points: Any = None,
    masks: Any = None,
    background: str | None = None,
    *,
    names: Sequence[str] | None = None,
    held_out: Sequence[int] = (),
    space: Spaces = "auto",
    near: float | None = None,
    far: float | None = None,
    name: str = "in_memory",
) -> Scene:
    """Return a scene of images and cameras in memory; frame, extent and space follow from them as from a capture.

    Args:
        images: a list or an array of (height, width, 3 or 4), uint8 or floats in [0, 1], with straight alpha; their
            sizes may differ.
        cameras: one per image, in the user's own frame and units (float64 where that is a map's).
        points: sparse points in that frame, (points, 3), which tell where the content lies; None: unknown.
        masks: for each image (height, width), above 0 where a pixel is learned from and judged; None: everywhere.
        background: what lies behind the scene: white, black, random or none; None: black.
        names: of the views; None: view_0000 and so on.
        held_out: numbers of the views for evaluation, from which nothing is learned; none: `val` and `test` are empty.
        space: `bounded`, `contracted`, `ndc` or `auto`, as in `nl.read`.
        near: nearest distance of the content from the cameras, in the user's units; None: it is estimated.
        far: the farthest.
        name: of the scene.

    Raises:
        InputError: images, masks and cameras that do not fit together, or no scene.
    """
    check_extent(space, near, far)
    count = len(images)
    names = [f"view_{number:04d}" for number in range(count)] if names is None else [str(each) for each in names]
    sparse = np.zeros((0, 3)) if points is None else np.asarray(points, np.float64)
    if (
        cameras.c2w.dim() != 3
        or {len(cameras.c2w), len(names), len(images if masks is None else masks)} != {count}
        or not count
    ):
        raise InputError(
            f"{SOURCE}: {count} images need as many cameras, and as many masks and names where you give some."
        )
    if sparse.shape[1:] != (3,) or not set(held_out) <= set(range(count)):
        raise InputError(
            f"{SOURCE}: points have the shape (points, 3), and held_out numbers of the {count} images; these are "
            f"{sparse.shape} and {list(held_out)}."
        )
    sizes = list(zip(cameras.width.tolist(), cameras.height.tolist(), strict=True))
    pixels = _store(images, sizes, masks)
    views = tuple(_view(each, cameras[number]) for number, each in enumerate(names))
    left_out = LeftOut(SOURCE)
    capture = usable(Capture(views, Path(SOURCE), cameras.lens_model, torch.from_numpy(sparse), left_out=left_out))
    if len(capture.views) < count:
        raise InputError(next(iter(left_out.faults.values()), f"{SOURCE}: two images have the same name."))
    held = tuple(sorted(set(held_out)))
    return scene_of(
        capture,
        cameras_of(capture, sizes, pixels, downscale=1),
        pixels,
        {"train": tuple(sorted({*range(count)} - {*held})), "val": held, "test": held},
        name=name,
        space=space,
        near=near,
        far=far,
        background=background_for(background, None, "black"),
        protocol={},
    )


def _view(name: str, camera: Cameras) -> View:
    focal, center, lens = (tuple(numbers.tolist()) for numbers in (camera.focal, camera.center, camera.lens))
    size = float(camera.width), float(camera.height)
    return View(name, Photograph(Path(name)), camera.c2w.double().cpu(), focal, center, size, lens)


def _store(images: Any, sizes: Sequence[tuple[int, int]], masks: Any) -> PixelStore:
    """Return the pixels of images of these sizes (width, height), in one array."""
    pixels, kept = empty_store(sizes), []
    for view, (width, height) in enumerate(sizes):
        rgba = _rgba(np.asarray(images[view]), view)
        mask = np.ones((height, width)) if masks is None else np.asarray(masks[view])
        if not rgba.shape[:2] == mask.shape == (height, width):
            raise InputError(
                f"{SOURCE}: the camera of image {view} takes {height} rows of {width} pixels, the image has the shape "
                f"{rgba.shape[:2]} and its mask {mask.shape}. Bring all three to one size."
            )
        pixels.view(view).numpy()[...] = rgba
        kept.append(torch.from_numpy((mask > 0).astype(np.uint8).ravel()))
    clear = bool((pixels.rgba[:, 3] < 255).any())
    return replace(pixels, has_transparency=clear, mask=None if masks is None else torch.cat(kept))


def _rgba(image: np.ndarray, view: int) -> UInt8[np.ndarray, "height width 4"]:
    """Return an image as RGBA; floats run from 0 to 1."""
    if image.ndim != 3 or image.shape[2] not in (3, 4) or not (image.dtype == np.uint8 or image.dtype.kind == "f"):
        raise InputError(
            f"{SOURCE}: image {view} has the shape {image.shape} of {image.dtype}. Give (height, width, 3 or 4) of "
            "uint8, or of floats from 0 to 1; alpha is straight (not premultiplied)."
        )
    if image.dtype != np.uint8:
        image = np.rint(255.0 * image.clip(0.0, 1.0)).astype(np.uint8)
    opaque = np.full((*image.shape[:2], 1), 255, np.uint8)
    return image if image.shape[2] == 4 else np.concatenate([image, opaque], axis=2)
