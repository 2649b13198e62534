"""3D Gaussian splats, and their projection through a camera (Kerbl et al. 2023, arXiv 2308.04079).

Letters: `mean` m and `covariance` S of a Gaussian in the world, W the world-to-camera rotation (rows right, down,
forward), (x, y, z) the mean in camera axes, J the Jacobian of the perspective (x fx / z, y fy / z) there, `conic` the
inverse of the covariance on the screen, in 1 / pixels^2.

The page repeats projection and thresholds: `page_files/splats.vert`, `splats.frag` and `splats.js`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.nerf.encoders.spherical_harmonics import DEGREE_1, SphericalHarmonicsEncoder
from nerf_lightning.nerf.geometry.poses import rotation_from_quaternion
from nerf_lightning.nerf.types.scene import Cameras

DILATION = 0.1
"""Pixels^2 added to each covariance on the screen, so that no splat falls between two pixels.

Viewers add 0.3 for any picture size: equivalent to this for a picture 1.7 times as large as those fitted to.
"""
LEAST_ALPHA, LARGEST_ALPHA = 1.0 / 255.0, 0.99
"""Less opaque contributions are not drawn, and larger alphas are clamped."""
LEAST_LIGHT = 1e-4
"""Splats behind less transmittance are not drawn."""
MARGIN = 1.3
"""Factor beyond the picture's extent at which the Jacobian's distance from the axis is clamped: it would explode."""
TURN = torch.tensor([1.0, -1.0, -1.0])
"""From a camera's axes right, up, back to right, down, forward."""


@dataclass
class Gaussians:
    """N splats. All numbers are as in files: before the exponential, the logistic function, and the offset."""

    means: Float[Tensor, "n 3"]
    log_scales: Float[Tensor, "n 3"]
    """Logarithms of the standard deviations along the splat's own axes, in scene units."""
    quaternions: Float[Tensor, "n 4"]
    """(w, x, y, z) of the rotation whose columns are the splat's axes; normalized wherever it is used."""
    opacity_logits: Float[Tensor, "n"]
    sh_dc: Float[Tensor, "n 3"]
    """Spherical harmonics of the color, which is 0.5 plus their sum, clamped at 0: the constant one,"""
    sh_rest: Float[Tensor, "n coefficients 3"]
    """and the 0, 3, 8 or 15 of degree 1 to 3."""

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """0 to 3."""
        return math.isqrt(self.sh_rest.shape[1] + 1) - 1

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def map(self, change: Callable[[Tensor], Tensor]) -> "Gaussians":
        """Return splats with transformed tensors: `gaussians.map(lambda each: each[kept])`."""
        return Gaussians(**{name: change(each) for name, each in self.tensors().items()})


@dataclass(frozen=True)
class Pinhole:
    """One camera for rasterizers."""

    rotation: Float[Tensor, "3 3"]
    """W: world to camera, rows right, down, forward."""
    eye: Float[Tensor, "3"]
    focal: tuple[float, float]
    center: tuple[float, float]
    width: int
    height: int
    near: float
    """Splats whose mean is nearer along the axis (scene units) are not drawn."""

    @classmethod
    def of(cls, cameras: Cameras, view: int, near: float) -> "Pinhole":
        """Return one of the cameras without its lens; in normalized device coordinates, content begins at z = -1."""
        c2w = cameras.c2w[view]
        near = near if cameras.ndc is None else 1.0 + float(c2w[2, 3])
        (fx, fy), (cx, cy) = cameras.focal[view].tolist(), cameras.center[view].tolist()
        size = int(cameras.width[view]), int(cameras.height[view])
        return cls(TURN.to(c2w)[:, None] * c2w[:, :3].mT, c2w[:, 3], (fx, fy), (cx, cy), *size, near)


@dataclass(frozen=True)
class Projected:
    """Splats on the screen."""

    means: Float[Tensor, "n 2"]
    """In pixels from the upper left corner (x, y)."""
    conics: Float[Tensor, "n 3"]
    """a, b, c of the inverse covariance [[a, b], [b, c]]."""
    depth: Float[Tensor, "n"]
    """Along the camera's axis."""


def covariances(gaussians: Gaussians) -> Float[Tensor, "n 3 3"]:
    """Return R diag(s^2) R^T (Eq. 6, arXiv 2308.04079)."""
    spread = rotation_from_quaternion(gaussians.quaternions) * gaussians.log_scales.exp()[:, None, :]
    return spread @ spread.mT


def project(gaussians: Gaussians, camera: Pinhole) -> Projected:
    """Return the splats on the screen: J W S W^T J^T + DILATION (EWA, Zwicker et al. 2001; Eq. 5, arXiv 2308.04079)."""
    local = (gaussians.means - camera.eye) @ camera.rotation.mT
    x, y, z = local.unbind(dim=-1)
    (fx, fy), (cx, cy) = camera.focal, camera.center
    limit_x, limit_y = jacobian_limits(camera)
    slope_x, slope_y = (x / z).clamp(-limit_x, limit_x), (y / z).clamp(-limit_y, limit_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * slope_x / z, zero, fy / z, -fy * slope_y / z], dim=-1)
    to_screen = jacobian.unflatten(-1, (2, 3)) @ camera.rotation
    covariance = to_screen @ covariances(gaussians) @ to_screen.mT
    xx, xy, yy = covariance[:, 0, 0] + DILATION, covariance[:, 0, 1], covariance[:, 1, 1] + DILATION
    conics = torch.stack([yy, -xy, xx], dim=-1) / (xx * yy - xy * xy)[:, None]
    return Projected(torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1), conics, z)


def jacobian_limits(camera: Pinhole) -> tuple[float, float]:
    """Return the largest |x / z| and |y / z| at which the Jacobian is taken."""
    (fx, fy), (cx, cy) = camera.focal, camera.center
    return MARGIN * max(cx, camera.width - cx) / fx, MARGIN * max(cy, camera.height - cy) / fy


def colors(gaussians: Gaussians, eye: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
    """Return the colors seen from `eye`; no gradient flows through the direction, which hardly changes."""
    directions = normalize(gaussians.means.detach() - eye, dim=-1)
    basis = SphericalHarmonicsEncoder(gaussians.sh_degree + 1)(directions)
    sh = torch.cat([gaussians.sh_dc[:, None], gaussians.sh_rest], dim=1)
    return (0.5 + (basis[:, :, None] * sh).sum(dim=1)).clamp(min=0)


def dc_of_color(rgb: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Return the constant coefficient of a view-independent color."""
    return (rgb - 0.5) / DEGREE_1
