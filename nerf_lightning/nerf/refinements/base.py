"""The contract of a refinement: cameras in, cameras out, as a function of parameters that learn with the model."""

from abc import ABC, abstractmethod

from nerf_lightning.nerf.part import Part
from nerf_lightning.nerf.types.scene import Cameras, Scene


class Refinement(Part, ABC):
    """Cameras that learn: where they start from, every parameter is zero and nothing is changed."""

    def fit_to(self, scene: Scene) -> None:
        """Take note of the cameras and of the scene's extent, once, before training.

        Raises:
            InputError: a scene whose cameras cannot be learned.
        """

    @abstractmethod
    def forward(self, cameras: Cameras) -> Cameras:
        """Return the cameras as they have been learned so far."""

    def moves(self) -> bool:
        """Return whether there is anything to learn."""
        return next(self.parameters(), None) is not None


class NoRefinement(Refinement):
    """Leave the cameras as they were read."""

    def forward(self, cameras: Cameras) -> Cameras:
        """Return the same cameras."""
        return cameras
