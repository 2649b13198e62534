"""Scale cameras to the pixels that are read, and turn photographs by their EXIF orientation if cameras need it."""

import logging
from dataclasses import replace

import torch

from nerf_lightning.data.captures.capture import Capture, View
from nerf_lightning.data.captures.checks import FARTHEST, LEAST_FOCAL, cameras_as_given
from nerf_lightning.data.pixels.downscale import downscaled_size
from nerf_lightning.data.pixels.picture_files import QUARTER_TURNS, read_header
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.scene import Cameras, PixelStore

LARGEST_STRETCH = 0.01
"""How much a picture's scale may differ between width and height."""

log = logging.getLogger(__name__)


def as_calibrated(capture: Capture) -> Capture:
    """Return the capture with photographs rotated if their EXIF tag says so and only that fits the camera's size.

    Programs that find cameras read the pixels as stored, or rotated upright; the sizes tell which. Views whose
    photograph is unreadable, or fits its camera in neither way, are left out.
    """
    views, kept, turned = list(capture.views), [], []
    for number, view in enumerate(views):
        with capture.left_out.unless_usable(view.name):
            header = view.photograph.header or read_header(view.photograph.path)
            orientation, (width, height) = header.orientation, header.size
            upright = orientation in QUARTER_TURNS and not _fits(view, width, height) and _fits(view, height, width)
            views[number] = replace(view, photograph=replace(view.photograph, upright=upright, header=header))
            require_fit(view, *((height, width) if upright else (width, height)))
            kept.append(number)
            if orientation != 1:
                turned.append(number)
    capture.left_out.require_enough(len(kept))
    if turned:
        as_shown = sum(views[number].photograph.upright for number in turned)
        log.info(
            "%s: %d of %d photographs are rotated by EXIF; the rotation is applied to %d, whose sizes match their "
            "cameras only then, and not to the others",
            *(capture.source, len(turned), len(kept), as_shown),
        )
    return replace(capture, views=tuple(views)).some(kept)


def _fits(view: View, width: int, height: int) -> bool:
    # A shrunk picture's size is rounded: allow a pixel either way.
    return abs(width / view.size[0] * view.size[1] / height - 1.0) <= LARGEST_STRETCH + 1.0 / min(width, height)


def require_fit(view: View, width: int, height: int) -> None:
    """Refuse a picture that is not a shrunk copy of what its camera describes."""
    if not _fits(view, width, height):
        raise InputError(
            f"{view.photograph.path} has {width} x {height} pixels, but its camera was calibrated for {view.size[0]:g} "
            f"x {view.size[1]:g}: the sides differ by different factors ({width / view.size[0]:.3f} "
            f"and {height / view.size[1]:.3f}). The picture was cropped, rotated or stretched after the poses were "
            "estimated; use the original one."
        )


def cameras_of(capture: Capture, files: list[tuple[int, int]], pixels: PixelStore, downscale: int) -> Cameras:
    """Return the cameras at the size of the pixels that were read.

    The intrinsics are valid for the sizes in the format, `files` are (width, height) of each picture file, and the
    remainder of `downscale` was cropped at the right and the bottom.

    Raises:
        InputError: a picture is not a shrunk copy of what its camera describes, or the pixels are of another capture.
    """
    sizes = [downscaled_size(width, height, downscale) for width, height in files]
    if sizes != list(zip(pixels.width.tolist(), pixels.height.tolist(), strict=True)):
        raise InputError(
            f"The cached pixels of {capture.source} have other sizes than its photographs, so something else wrote "
            "them. Remove them from scene.cache_dir (by default ~/.cache/nerf_lightning), and the photographs will be "
            "read again."
        )

    scales = []
    for view, (width, height) in zip(capture.views, files, strict=True):
        require_fit(view, width, height)
        scales.append((width / view.size[0] / downscale, height / view.size[1] / downscale))
    scale, given = torch.tensor(scales, dtype=torch.float64), cameras_as_given(capture)
    focal = given.focal * scale
    possible = ((focal >= LEAST_FOCAL) & (focal <= FARTHEST)).all(dim=-1)
    if not bool(possible.all()):
        view = capture.views[possible.tolist().index(False)]
        raise InputError(
            f"{capture.source}: the view {view.name} has a focal length of {view.focal[0]:g}, {view.focal[1]:g} pixels "
            f"of {view.size[0]:g} x {view.size[1]:g}, which no lens has on the picture that is there. Export it again."
        )
    return replace(
        given,
        focal=focal.float(),
        center=(given.center * scale).float(),
        lens=given.lens.float(),
        width=pixels.width,
        height=pixels.height,
    )
