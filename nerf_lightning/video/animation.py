"""Animated pictures, which a page or a message shows by itself: WebP, in a loop without end."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from nerf_lightning.errors import InputError
from nerf_lightning.files.atomic import whole_file

LARGEST_SIDE = 16383
"""Of a WebP, in pixels."""
QUALITY = 80


def write_animation(
    path: Path, frames: Iterable[UInt8[Tensor, "height width channels"]], fps: int, total: int | None = None
) -> None:
    """Write frames of one size as an animated WebP, whole or not at all.

    Args:
        path: where to. Missing folders are made.
        frames: pictures in RGB, or in RGB and straight alpha, row 0 on top.
        fps: frames per second; each is shown for a whole number of milliseconds, equal neighbours as one.
        total: how many frames there should be, where it is known.

    Raises:
        InputError: frames larger than the format's largest.
        ValueError: no frames, or another number than `total`.
    """
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ValueError(f"{path}: an animation needs at least one frame")
    height, width, _ = first.shape
    if max(height, width) > LARGEST_SIDE:
        raise InputError(
            f"{path}: a frame of {width} x {height} pixels is larger than a WebP can be, {LARGEST_SIDE} on a side. "
            "Lower path.width, or write format=video."
        )
    count = 1

    def others() -> Iterator[Image.Image]:
        nonlocal count
        for frame in frames:
            count += 1
            yield Image.fromarray(frame.numpy())

    with whole_file(path) as part:
        Image.fromarray(first.numpy()).save(
            part, "WEBP", save_all=True, append_images=others(), duration=round(1000 / fps), loop=0, quality=QUALITY
        )
        if total is not None and count != total:
            raise ValueError(f"{path}: {count} frames came, {total} were promised")
