"""Small motions of cameras, one per photograph, and their focal lengths and lenses, one per camera.

What is refined, how fast and from when on: `conf/refinement/`.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import which_camera
from nerf_lightning.nerf.geometry.lenses import with_coefficients
from nerf_lightning.nerf.geometry.poses import rotation_from_vector
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.part import StepContext
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.refinements.base import Refinement
from nerf_lightning.nerf.types.scene import Cameras, Scene

FEWEST_PHOTOGRAPHS = 2


class SE3Delta(Refinement):
    """Shift and rotate each camera slightly: SO(3) x R^3, by the exponential map.

    R' = R exp(w + (-s_y, s_x, 0) / d), c' = c + R s with s = e t, f' = f exp(g), k1' = k1 + h1, k2' = k2 + h2. The
    vector w rotates the camera about its own axes (radians); the shift t, along them, is in units of the scene's extent
    e (half the diagonal of its box). All photographs of one camera share g and h, the changes of its focal length and
    of the radial coefficients of its lens; a camera given as a pinhole may turn out to have a lens. All are zero
    initially. A photograph that is not trained on has no gradients, and does not move.

    Rotating and shifting sideways move a picture almost alike, and an optimizer that treats each number separately
    wavers between the two. So a shifted camera turns back to what is at the distance d of the scene's middle: w is the
    picture's displacement, and t its parallax.

    The loss does not change if all cameras and the whole scene move together (rotation, shift, scale); the penalty
    keeps them from drifting that way.

    Args:
        poses: refine the rotation and translation of each camera (w and t).
        focal: refine the focal length of each camera (g).
        lens: refine the radial coefficients of each camera's lens (h1 and h2).
        learning_rate: the initial learning rate of all of them; the run's schedule scales it.
        hold: share of the run in which cameras are fixed: without a scene to align to, they would drift.
        weight: weight of the penalty: the sum of squares of all of these, divided by the number of photographs.
    """

    replays = False
    extent: Tensor
    distance: Tensor
    camera: Tensor

    def __init__(
        self,
        poses: bool = True,
        focal: bool = False,
        lens: bool = False,
        learning_rate: float = 3e-4,
        hold: float = 0.1,
        weight: float = 1e-2,
    ) -> None:
        super().__init__()
        require_ranges(locals(), {"learning_rate": (1e-8, 1.0), "hold": (0.0, 1.0), "weight": (0.0, 1e6)})
        if not (poses or focal or lens):
            raise ValueError("poses=false, focal=false and lens=false leave nothing to learn: choose refinement=none")
        self.poses, self.focal, self.lens = poses, focal, lens
        self.learning_rate, self.hold, self.weight = learning_rate, hold, weight
        self.is_held = False

    def on_step(self, context: StepContext) -> None:
        """Release the cameras when it is time."""
        self.is_held = context.progress < self.hold

    def fit_to(self, scene: Scene) -> None:
        """Record the cameras and the scene's extent, once, before training.

        Raises:
            InputError: rays are in normalized device coordinates, there are too few photographs, or more than the poses
                of panoramas is to be learned.
        """
        if scene.cameras.ndc is not None:
            raise InputError(
                f"refinement: the scene {scene.name} is trained in normalized device coordinates (scene.space=ndc), "
                "which assume cameras that look straight ahead, so a rotated camera would no longer fit the others. "
                "Train with scene.space=contracted, or with refinement=none."
            )
        if (self.focal or self.lens) and scene.cameras.lens_model == "equirectangular":
            raise InputError(
                f"refinement: the scene {scene.name} has panoramas, which have neither a focal length nor a lens. "
                "Refine only their poses, with refinement=se3, or choose refinement=none."
            )
        photographs = len(scene.splits["train"])
        if photographs < FEWEST_PHOTOGRAPHS:
            raise InputError(
                f"refinement: the scene {scene.name} trains on {photographs} photograph, and a camera can be refined "
                "only relative to others. Give more photographs, or refinement=none."
            )
        self.learn(scene.cameras, scene.aabb, photographs)

    def learn(self, cameras: Cameras, aabb: Float[Tensor, "2 3"], photographs: int) -> None:
        """Allocate the parameters of cameras; `photographs` of them are trained on, and the box contains the scene."""
        views = len(cameras.width)
        extent = (aabb[1] - aabb[0]).norm() / 2.0
        ahead = -((aabb.mean(dim=0) - cameras.c2w[:, :, 3]) * cameras.c2w[:, :, 2]).sum(dim=1)
        camera = which_camera(cameras)
        self.photographs = photographs
        self.register_buffer("extent", extent, persistent=False)
        self.register_buffer("distance", torch.maximum(ahead, extent / 2.0), persistent=False)
        self.register_buffer("camera", camera, persistent=False)
        if self.poses:
            self.rotation = nn.Parameter(torch.zeros(views, 3))
            self.shift = nn.Parameter(torch.zeros(views, 3))
        if self.focal:
            self.log_focal = nn.Parameter(torch.zeros(int(camera.max()) + 1))
        if self.lens:
            self.radial = nn.Parameter(torch.zeros(int(camera.max()) + 1, 2))

    @disable_autocast
    def forward(self, cameras: Cameras) -> Cameras:
        """Return the cameras as learned so far."""
        if self.is_held:
            return cameras
        if self.poses:
            shift, axes = self.extent * self.shift, cameras.c2w[..., :3]
            back = torch.stack([-shift[:, 1], shift[:, 0], torch.zeros_like(shift[:, 0])], dim=1)
            turned = axes @ rotation_from_vector(self.rotation + back / self.distance[:, None])
            centers = cameras.c2w[..., 3:] + axes @ shift[..., None]
            cameras = replace(cameras, c2w=torch.cat([turned, centers], dim=-1))
        if self.focal:
            cameras = replace(cameras, focal=cameras.focal * self.log_focal.exp()[self.camera, None])
        if self.lens:
            lens = cameras.lens + pad(self.radial[self.camera], (0, 4))
            cameras = replace(cameras, lens=lens, lens_model=with_coefficients(cameras.lens_model))
        return cameras

    def penalty(self) -> Float[Tensor, ""] | None:
        """Return the weighted sum of squared changes, divided by the number of photographs."""
        if not self.weight:
            return None
        squares = [parameter.square().sum() for parameter in self.parameters()]
        return self.weight / self.photographs * torch.stack(squares).sum()

    def reset_parameters(self) -> None:
        """Reset every camera."""
        for parameter in self.parameters():
            nn.init.zeros_(parameter)
