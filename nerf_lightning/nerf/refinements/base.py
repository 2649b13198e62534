"""The contract of a refinement: cameras in, cameras out, as a function of parameters learned with the model."""

from abc import ABC, abstractmethod

from nerf_lightning.nerf.part import Part
from nerf_lightning.nerf.types.scene import Cameras, Scene


class Refinement(Part, ABC):
    """Cameras that learn: initially every parameter is zero and nothing is changed."""

    def fit_to(self, scene: Scene) -> None:
        """Record the cameras and the scene's extent, once, before training.

        Raises:
            InputError: the scene's cameras cannot be learned.
        """

    @abstractmethod
    def forward(self, cameras: Cameras) -> Cameras:
        """Return the cameras as learned so far."""

    def moves(self) -> bool:
        """Return whether there is anything to learn."""
        return next(self.parameters(), None) is not None


class NoRefinement(Refinement):
    """Leave the cameras unchanged."""

    def forward(self, cameras: Cameras) -> Cameras:
        """Return the same cameras."""
        return cameras
