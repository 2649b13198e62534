"""The contract of a reader: one class per format, `read()` returns a `Scene`."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch

from nerf_lightning.data.captures.checks import FARTHEST, check_metres, check_step
from nerf_lightning.data.pixels.plain_background import background_for, cut_out, protocol_of
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.types.scene import Background, Cameras, PixelStore, Scene


class Reader(ABC):
    """Read a capture. The constructor only keeps its arguments; every file access happens in `read`."""

    named_by: ClassVar[tuple[str, ...]] = ()
    """Endings of files of this format that `scene=auto scene.root=FILE` may name."""

    @classmethod
    def found_in(cls, folder: Path) -> str | None:
        """Return the file by which this format is known, where a folder has it; formats that are not searched: None."""
        return None

    @abstractmethod
    def read(self) -> Scene:
        """Return the whole capture, all splits.

        Raises:
            InputError: anything wrong with the files, with the file's name and the cure.
        """


@dataclass(kw_only=True)
class GivenFrameReader(Reader):
    """Read a scene of pictures of one size whose frame is kept, with a near, a far and a box that a person gives.

    Args:
        near: distance along every ray at which content begins, scene units.
        far: distance at which content ends.
        background: the background of the images or of their transparent pixels: white, black, random or none. null:
            white in the Blender format, otherwise black; if a plain background was cut out, white_or_random,
            black_or_random or random, depending on its color.
        cut_out: if opaque images show an object on a plain background, make that transparent.
        downscale: integer factor by which images are shrunk (area filter on premultiplied colors); the focal length is
            scaled, too.
        aabb_half: half the side of the box around the origin that contains the scene, scene units.
        name: the scene's name in reports.
    """

    near: float = 2.0
    far: float = 6.0
    background: str | None = None
    cut_out: bool = True
    downscale: int = 1
    aabb_half: float = 1.5
    name: str

    def check_settings(self) -> None:
        """Refuse settings that make no sense, before any file is read."""
        check_step("downscale", self.downscale)
        background_for(self.background, None, "black")
        if not 0.0 <= self.near < self.far <= FARTHEST:
            raise InputError(
                f"scene.near is {self.near} and scene.far is {self.far}, but rays need 0 <= near < far <= "
                f"{FARTHEST:g}. Set them to the distances from the cameras at which the content begins and ends, for "
                "example scene.near=2.0 scene.far=6.0."
            )
        if not 0 < self.aabb_half <= FARTHEST:
            raise InputError(
                f"scene.aabb_half is {self.aabb_half}, but half the side of a box must be above 0, and {FARTHEST:g} at "
                "most."
            )

    def check_divisible(self, width: int, height: int) -> None:
        """Refuse a downscale that does not divide the pictures' size: this camera model knows no partial pixels."""
        common = math.gcd(width, height)
        if common % self.downscale:
            factors = [factor for factor in range(1, common + 1) if common % factor == 0]
            raise InputError(
                f"scene.downscale={self.downscale} does not divide the images' size of {width} x {height} pixels. "
                f"Choose one of {listed(factors, cap=40)}."
            )

    def scene(
        self,
        cameras: Cameras,
        pixels: PixelStore,
        splits: dict[str, tuple[int, ...]],
        names: Sequence[str],
        protocol: dict[str, str],
        otherwise: Background,
        metres_per_unit: float | None = None,
    ) -> Scene:
        """Return the scene, with a plain background cut out; `otherwise` lies behind one that has none."""
        check_metres(metres_per_unit)
        pixels, color = cut_out(pixels, self.name, self.cut_out and self.background != "none")
        return Scene(
            name=self.name,
            cameras=cameras,
            pixels=pixels,
            near=torch.full((len(names),), float(self.near)),
            far=torch.full((len(names),), float(self.far)),
            aabb=torch.tensor([[-self.aabb_half] * 3, [self.aabb_half] * 3], dtype=torch.float32),
            splits=splits,
            view_names=tuple(names),
            background=background_for(self.background, color, otherwise),
            to_user=torch.eye(4, dtype=torch.float64),
            metres_per_unit=metres_per_unit,
            protocol={"downscale": str(self.downscale)} | protocol | protocol_of(color),
            truth=None,
        )
