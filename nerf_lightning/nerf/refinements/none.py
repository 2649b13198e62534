"""Cameras that are right as they are."""

from nerf_lightning.nerf.refinements.base import Refinement
from nerf_lightning.nerf.types.scene import Cameras


class NoRefinement(Refinement):
    """Leave the cameras as they were read."""

    def forward(self, cameras: Cameras) -> Cameras:
        """Return the same cameras."""
        return cameras
