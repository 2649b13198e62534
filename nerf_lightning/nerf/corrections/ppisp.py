"""What a camera makes of light, from the lens to the file (PPISP, arXiv 2601.18336).

Letters: linear light (r, g, b), intensity i = r + g + b, place in the picture u from its middle in units of its longer
side, encoded colour x. Each part is written as a change of what comes in, which is 0 to the bit where its parameters
are.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import smooth_l1_loss, softplus

from nerf_lightning.nerf.corrections.base import Correction
from nerf_lightning.nerf.geometry.cameras import which_camera
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.rendering.linear_light import scale_light, to_encoded, to_linear
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.scene import Scene

CORNERS = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1 / 3, 1 / 3]])
"""Chromaticities (r, g) / i of pure blue, red, green and of grey, which the homography moves."""
REACH = torch.tensor([0.05, 0.05, 0.05, 0.0125])[:, None]
"""How far a parameter of 1 moves each: by about as much as a photograph changes visibly."""
LEAST_CURVE = torch.tensor([0.3, 0.3, 0.1])
"""Of toe, shoulder and gamma."""
LEAST_FALLOFF, DARK, END = 1e-3, 1e-5, 1e-4


class PhysicalCamera(Correction):
    """Per photograph exposure and a homography of chromaticity, per camera vignetting and a response curve.

    Unlike the paper's, our model shows encoded colours: exposure, vignetting and homography act on their linear light,
    the curve on what is encoded again. Vignetting that grows brighter outwards is held back by a penalty alone: cut
    off at 1, it would learn no more. The homography's numbers are scaled one by one, and nothing predicts what a
    camera would choose for a new view: that is shown in neutral colours.

    Args:
        learning_rate: of all parameters.
        mean_weight: on the means over photographs of exposure and chromaticity, which the model could show as well.
        center_weight: on how far the middle of the vignetting is from the picture's.
        brightening_weight: on vignetting that grows brighter outwards.
        channel_weight: on how much vignetting and curve differ between red, green and blue.
    """

    trained: Tensor
    camera: Tensor
    size: Tensor
    corners: Tensor
    reach: Tensor
    least_curve: Tensor

    def __init__(
        self,
        learning_rate: float = 1e-2,
        mean_weight: float = 1.0,
        center_weight: float = 0.02,
        brightening_weight: float = 0.01,
        channel_weight: float = 0.1,
    ):
        super().__init__()
        weight = (0.0, 1e6)
        ranges = {"learning_rate": (1e-8, 1.0), "mean_weight": weight, "center_weight": weight}
        require_ranges(locals(), ranges | {"brightening_weight": weight, "channel_weight": weight})
        self.learning_rate, self.mean_weight, self.center_weight = learning_rate, mean_weight, center_weight
        self.brightening_weight, self.channel_weight = brightening_weight, channel_weight
        # Where the parameters are: sent there in each step, the host would wait for them.
        for name, value in (("corners", CORNERS), ("reach", REACH), ("least_curve", LEAST_CURVE)):
            self.register_buffer(name, value, persistent=False)
        self._make_room(1, torch.zeros(1, dtype=torch.int64), torch.ones(1, 2), torch.zeros(1, dtype=torch.int64))

    def fit_to(self, scene: Scene) -> None:
        """Make room for each photograph and each camera.

        Raises:
            InputError: there is but one photograph.
        """
        super().fit_to(scene)
        cameras = scene.cameras
        size = torch.stack([cameras.width, cameras.height], dim=1).float()
        self._make_room(len(scene.view_names), which_camera(cameras), size, torch.tensor(scene.splits["train"]))

    def _make_room(self, num_views: int, camera: Tensor, size: Tensor, trained: Tensor) -> None:
        num_cameras = int(camera.max()) + 1
        self.exposure = nn.Parameter(torch.zeros(num_views))
        self.chromaticity = nn.Parameter(torch.zeros(num_views, 4, 2))
        self.middle = nn.Parameter(torch.zeros(num_cameras, 3, 2))
        self.falloff = nn.Parameter(torch.zeros(num_cameras, 3, 3))
        self.curve = nn.Parameter(torch.zeros(num_cameras, 3, 4))
        for name, value in (("camera", camera), ("size", size), ("trained", trained)):
            self.register_buffer(name, value, persistent=False)

    def forward(self, rgb: Float[Tensor, "*rays 3"], pixels: PixelIndex) -> Float[Tensor, "*rays 3"]:
        """Return the colours as the photographs' cameras show them."""
        camera = self.camera[pixels.view]
        gain = torch.exp2(self.exposure)[pixels.view, None] * self._vignetting(pixels, camera)
        exposed = scale_light(rgb, gain)
        light = to_linear(exposed)
        change = _recolored(light, self._homographies()[pixels.view])
        tinted = exposed + (to_encoded(light + change) - to_encoded(light))
        inside, curve = tinted.clamp(END, 1.0 - END), self.curve[camera]
        least = self.least_curve
        return tinted + (_response(inside, curve, least) - _response(inside, torch.zeros_like(curve), least))

    def penalty(self) -> Float[Tensor, ""]:
        """Return what holds the parameters near what is likely, as in the paper."""
        exposure = self.exposure[self.trained].mean()
        moved = (self.chromaticity[self.trained] * self.reach).mean(dim=0)
        means = smooth_l1_loss(exposure, torch.zeros_like(exposure), beta=0.1)
        means = means + smooth_l1_loss(moved, torch.zeros_like(moved), beta=0.005)
        kinds = (torch.cat([self.middle, self.falloff], dim=-1), self.curve)
        return (
            self.mean_weight * means
            + self.center_weight * self.middle.square().sum(dim=-1).mean()
            + self.brightening_weight * self.falloff.relu().mean()
            + self.channel_weight * sum((kind.var(dim=1, unbiased=False).mean() for kind in kinds), exposure * 0.0)
        )

    def reset_parameters(self) -> None:
        """Begin with photographs and cameras that change nothing."""
        for parameter in self.parameters():
            nn.init.zeros_(parameter)

    def _vignetting(self, pixels: PixelIndex, camera: Tensor) -> Float[Tensor, "*rays 3"]:
        size = self.size[pixels.view]
        place = (torch.stack([pixels.x, pixels.y], dim=-1) + 0.5 - size / 2.0) / size.amax(dim=-1, keepdim=True)
        squared = (place[..., None, :] - self.middle[camera]).square().sum(dim=-1)
        powers = torch.stack([squared, squared**2, squared**3], dim=-1)
        return (1.0 + (self.falloff[camera] * powers).sum(dim=-1)).clamp(min=LEAST_FALLOFF)

    def _homographies(self) -> Float[Tensor, "views 3 3"]:
        # Of (r, g, i), less the identity.
        moved = _homography(self.corners + self.chromaticity * self.reach)
        return moved - _homography(self.corners + torch.zeros_like(self.chromaticity) * self.reach)


def _homography(corners: Float[Tensor, "views 4 2"]) -> Float[Tensor, "views 3 3"]:
    """Return the matrix that takes the chromaticities of blue, red, green and grey to these; its last number is 1."""
    to = torch.cat([corners, torch.ones_like(corners[..., :1])], dim=-1)
    blue, red, green, gray = to.unbind(-2)
    # grey = a blue + b red + c green by Cramer's rule, up to a factor; before, all three were a third.
    sides = [(red, green), (green, blue), (blue, red)]
    shares = [(gray * torch.linalg.cross(one, other)).sum(dim=-1, keepdim=True) for one, other in sides]
    blue, red, green = (share * corner for share, corner in zip(shares, (blue, red, green), strict=True))
    # Of (r, g, i), blue is (0, 0, 1), red (1, 0, 1), green (0, 1, 1).
    return torch.stack([red - blue, green - blue, blue], dim=-1) / blue[..., 2:, None]


def _recolored(light: Float[Tensor, "*rays 3"], matrix: Float[Tensor, "*rays 3 3"]) -> Float[Tensor, "*rays 3"]:
    """Return how light changes under homographies of (r, g, i), given less the identity, that keep the intensity."""
    intensity = light.sum(dim=-1, keepdim=True)
    rgi = torch.cat([light[..., :2], intensity], dim=-1)
    moved = (matrix * rgi[..., None, :]).sum(dim=-1)
    scale = (intensity + moved[..., 2:]).clamp(min=DARK)
    change = (intensity * moved[..., :2] - light[..., :2] * moved[..., 2:]) / scale
    return torch.cat([change, -change.sum(dim=-1, keepdim=True)], dim=-1)


def _response(
    x: Float[Tensor, "*rays 3"], curve: Float[Tensor, "*rays 3 4"], least: Float[Tensor, "3"]
) -> Float[Tensor, "*rays 3"]:
    """Return colours under toe, shoulder and gamma, which are 1 at zero, and where the former two meet, then 1/2."""
    toe, shoulder, gamma = (least + softplus(curve[..., :3] + torch.expm1(1.0 - least).log())).unbind(-1)
    meet = torch.sigmoid(curve[..., 3])
    height = shoulder * meet / (toe + meet * (shoulder - toe))
    low = x <= meet
    below = height * (torch.where(low, x, meet) / meet) ** toe
    above = 1.0 - (1.0 - height) * (torch.where(low, 1.0 - meet, 1.0 - x) / (1.0 - meet)) ** shoulder
    return torch.where(low, below, above) ** gamma
