"""Photographs that were exposed differently, under different white balance."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.nerf.corrections.base import Correction
from nerf_lightning.nerf.corrections.shared_points import Pairs, shared_points, solved_stops
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import surface_points
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.rendering.linear_light import scale_light
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.scene import Scene

FAR = 0.08
"""Stops, root mean square over photographs: on bricks, twice as much as solutions are off."""


class Exposure(Correction):
    """Per photograph one exposure, and the gains of red and blue against it, all in stops of linear light.

    The exposure is the mean of the three channels: green gains what red and blue lose.

    Neighbouring cameras see the same surfaces, so that what they have in common is told from the scene only by way of
    others: gradients take thousands of steps for it, in which the model learns to shine differently to each side. So
    once there is a scene, the stops may also be solved for, from the points that photographs share (`shared_points`).
    Where the solution is far from what gradients have found, the stops are set to it, and stay so until the next;
    where it is near (photographs that hardly differ), gradients are the more accurate, and go on.

    The light of all photographs can be scaled together, and the model's the other way: a penalty on the three means
    over the photographs that train holds them near zero, so that the neutral picture is exposed as the mean photograph.

    Args:
        learning_rate: of the stops; Adam moves each by at most about so much in a step.
        mean_weight: factor on the sum of the squared means, which is added to the loss.
        solves: how often the stops are solved for, after equal parts of the run; 0: they learn by gradients alone.
            3 finds planted exposures more exactly; it takes as long as some hundred steps, and real photographs gained
            nothing.
    """

    trained: Tensor
    solved: Tensor
    held: Tensor

    def __init__(self, learning_rate: float = 1e-2, mean_weight: float = 1.0, solves: int = 0):
        super().__init__()
        ranges = {"learning_rate": (1e-8, 1.0), "mean_weight": (0.0, 1e6), "solves": (0, 1000)}
        require_ranges(locals(), ranges)
        self.learning_rate, self.mean_weight, self.solves = learning_rate, mean_weight, solves
        self.scene: Scene | None = None
        self.stops = nn.Parameter(torch.zeros(1, 3))
        """Of each view: exposure, red, blue."""
        self.register_buffer("trained", torch.zeros(1, dtype=torch.int64), persistent=False)
        self.register_buffer("solved", torch.tensor(0))
        """How often."""
        self.register_buffer("held", torch.tensor(False))
        self.is_held = False

    def fit_to(self, scene: Scene) -> None:
        """Make room for each photograph.

        Raises:
            InputError: there is but one.
        """
        super().fit_to(scene)
        self.scene = scene
        self.stops = nn.Parameter(torch.zeros(len(scene.view_names), 3))
        self.trained = torch.tensor(scene.splits["train"])

    def forward(self, rgb: Float[Tensor, "*rays 3"], pixels: PixelIndex) -> Float[Tensor, "*rays 3"]:
        """Return the colours with their light scaled by the gains of their photographs."""
        return scale_light(rgb, self.gains()[pixels.view])

    def gains(self) -> Float[Tensor, "views 3"]:
        """Return the factors on the linear light of red, green and blue in each photograph."""
        return torch.exp2(_of_channels(self.stops.detach() if self.is_held else self.stops))

    def penalty(self) -> Float[Tensor, ""] | None:
        """Return the sum of the squared means of exposure, red and blue over the photographs that train."""
        return None if self.is_held else self.mean_weight * self.stops[self.trained].mean(dim=0).square().sum()

    def follow(self, share: float, model: Model, rays_of: RayGenerator, tile_points: int, key: int) -> None:
        """Solve for the stops where it is time."""
        due = int(share * (self.solves + 1))
        if self.scene is None or not due:
            return
        self.is_held = bool(self.held)
        if due <= int(self.solved):
            return
        was_training = model.training
        model.eval()

        def look(pixels: PixelIndex) -> tuple[Tensor, Tensor]:
            return surface_points(model, rays_of, pixels, tile_points)

        with torch.no_grad():
            self._solve(shared_points(self.scene, rays_of.cameras.to("cpu"), look, key))
        model.train(was_training)
        self.solved.fill_(due)

    def _solve(self, pairs: Pairs) -> None:
        """Set the stops to the solution, and hold them there, unless it is near."""
        before, trained = self.stops.cpu(), self.trained.cpu()
        red, green, blue = solved_stops(pairs, _of_channels(before)).unbind(-1)
        exposure = (red + green + blue) / 3.0
        way = (torch.stack([exposure, red - exposure, blue - exposure], dim=-1) - before)[trained]
        way -= way.mean(dim=0)
        if self.is_held or bool((way.square().mean(dim=0).sqrt() > FAR).any()):
            self.stops[self.trained] += way.to(self.stops)
            self.held.fill_(True)
            self.is_held = True

    def reset_parameters(self) -> None:
        """Begin with photographs that are all alike."""
        nn.init.zeros_(self.stops)
        self.solved.zero_()
        self.held.zero_()
        self.is_held = False


def _of_channels(stops: Float[Tensor, "views 3"]) -> Float[Tensor, "views 3"]:
    """Return the stops of red, green and blue."""
    exposure, red, blue = stops.unbind(-1)
    return torch.stack([exposure + red, exposure - red - blue, exposure + blue], dim=-1)
