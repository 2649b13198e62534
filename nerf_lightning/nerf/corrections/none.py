"""No correction: photographs show what there is."""

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.corrections.base import Correction
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.renderings import Rendering
from nerf_lightning.nerf.types.scene import Scene


class NoCorrection(Correction):
    """Leave every colour as it is."""

    def fit_to(self, scene: Scene) -> None:
        """Take any scene."""

    def photographed(self, rendering: Rendering, pixels: PixelIndex) -> Rendering:
        """Return the rendering itself."""
        return rendering

    def forward(self, rgb: Float[Tensor, "*rays 3"], pixels: PixelIndex) -> Float[Tensor, "*rays 3"]:
        """Return the colours themselves."""
        return rgb
