"""Lenses: how they distort a pinhole's image, and the inverse.

Axes are the lens's own: x right, y down, z forward, so that all formulas and signs are those of OpenCV (its modules
calib3d and fisheye). `plane` is a position in the image in focal lengths from the principal point, as photographed
(distorted). The six coefficients of `lens` are k1, k2, k3, k4, p1, p2; note that OpenCV lists the radial and tangential
ones as k1, k2, p1, p2, k3. Sources: Brown, "Close-range camera calibration", 1971; Kannala and Brandt, "A generic
camera model and calibration method", 2006.

`kernels/lenses/cpu.py` and `kernels/rays/cuda.py` repeat the iteration.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.panoramas import panorama_stretches, project_panorama, unproject_panorama
from nerf_lightning.nerf.kernels.backends import with_kernel
from nerf_lightning.nerf.types.scene import LensModel

NEWTON_STEPS = 8
"""Fixed, since shapes and control flow must not depend on values. Mild lenses need 3, strong ones 5."""
ON_AXIS = 1e-12
"""Smaller radii are clamped to this: the axis has no heading around it, and its gradient must be finite."""


def with_coefficients(model: LensModel) -> LensModel:
    """Return a camera's model once coefficients are learned: a pinhole is a lens without distortion."""
    return "radial_tangential" if model == "pinhole" else model


def project_plane(
    directions: Float[Tensor, "*rays 3"], lens: Float[Tensor, "*#rays 6"], model: LensModel
) -> Float[Tensor, "*rays 2"]:
    """Return the image positions at which the lens shows directions of any length.

    * pinhole: (x / z, y / z) =: (u, v); r^2 = u^2 + v^2.
    * radial_tangential: (u, v) (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8)
      + (2 p1 u v + p2 (r^2 + 2 u^2), p1 (r^2 + 2 v^2) + 2 p2 u v).
    * fisheye: theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) along (x, y), with theta the angle from the
      axis; directions behind the camera have a position, too.
    * equirectangular: azimuth and depression (`geometry.panoramas`).

    >>> lens = torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    >>> project_plane(torch.tensor([2.0, 0.0, 2.0]), lens, "radial_tangential").tolist()
    [1.100000023841858, 0.0]
    """
    if model == "equirectangular":
        return project_panorama(directions)
    if model == "fisheye":
        angle, heading = off_axis(directions)
        return (angle * _even_polynomial(angle.square(), lens)[0])[..., None] * heading
    plane = directions[..., :2] / directions[..., 2:]
    return plane if model == "pinhole" else _distorted(plane, lens)[0]


def unproject(
    plane: Float[Tensor, "*rays 2"], lens: Float[Tensor, "*#rays 6"], model: LensModel
) -> Float[Tensor, "*rays 3"]:
    """Return the directions (not of unit length) that the lens shows at image positions.

    The inverse of `project_plane` wherever `geometry.lens_checks.lens_faults` finds no fault.
    """
    if model == "equirectangular":
        return unproject_panorama(plane)
    if model == "fisheye":
        radius = _length(plane)
        return at_angle(_angle_at(radius, lens), plane / radius[..., None])
    if model == "radial_tangential":
        plane = undistort(plane, lens, NEWTON_STEPS)
    return torch.cat([plane, torch.ones_like(plane[..., :1])], dim=-1)


def stretches(
    directions: Float[Tensor, "*rays 3"], lens: Float[Tensor, "*#rays 6"], model: LensModel
) -> Float[Tensor, "*rays 2"]:
    """Return the lens's minimum and maximum stretch of its surroundings at each direction.

    For a fisheye, per radian: d theta_d / d theta along the radius and theta_d / sin(theta) around it; for a panorama
    per radian, too. For the others, relative to a pinhole: the eigenvalues of the Jacobian, which is symmetric. Where
    the minimum is not above 0, the lens folds back.
    """
    if model == "equirectangular":
        return panorama_stretches(directions)
    if model == "fisheye":
        angle, _ = off_axis(directions)
        factor, slope = _even_polynomial(angle.square(), lens)
        around = factor / torch.sinc(angle / torch.pi)
        both = torch.stack([factor + angle.square() * slope, around], dim=-1)
        return torch.stack([both.amin(dim=-1), both.amax(dim=-1)], dim=-1)
    plane = directions[..., :2] / directions[..., 2:]
    if model == "pinhole":
        return torch.ones_like(plane)
    _, (along_x, across, along_y) = _distorted(plane, lens)
    mean, spread = 0.5 * (along_x + along_y), torch.hypot(0.5 * (along_x - along_y), across)
    return torch.stack([mean - spread, mean + spread], dim=-1)


def off_axis(directions: Float[Tensor, "*rays 3"]) -> tuple[Float[Tensor, "*rays"], Float[Tensor, "*rays 2"]]:
    """Return the angle of each direction from the axis (radians, up to pi), and the unit heading around it."""
    radius = _length(directions[..., :2])
    return torch.atan2(radius, directions[..., 2]), directions[..., :2] / radius[..., None]


def at_angle(angle: Float[Tensor, "*rays"], heading: Float[Tensor, "*rays 2"]) -> Float[Tensor, "*rays 3"]:
    """Return the unit directions at angles from the axis; the inverse of `off_axis`."""
    return torch.cat([angle.sin()[..., None] * heading, angle.cos()[..., None]], dim=-1)


def _length(plane: Tensor) -> Tensor:
    return plane.square().sum(dim=-1).clamp(min=ON_AXIS**2).sqrt()


def _even_polynomial(square: Tensor, lens: Tensor) -> tuple[Tensor, Tensor]:
    # 1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4 of s = r^2, and its derivative by r, over r.
    k1, k2, k3, k4 = lens[..., :4].unbind(dim=-1)
    factor = 1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4)))
    return factor, 2.0 * k1 + square * (4.0 * k2 + square * (6.0 * k3 + square * (8.0 * k4)))


def _distorted(plane: Tensor, lens: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    # The radial and tangential model, and its Jacobian [[along_x, across], [across, along_y]].
    x, y = plane.unbind(dim=-1)
    p1, p2 = lens[..., 4:].unbind(dim=-1)
    xx, xy, yy = x * x, x * y, y * y
    radial, slope = _even_polynomial(xx + yy, lens)
    bent_x = x * radial + 2.0 * p1 * xy + p2 * (3.0 * xx + yy)
    bent_y = y * radial + p1 * (xx + 3.0 * yy) + 2.0 * p2 * xy
    along_x = radial + xx * slope + 2.0 * p1 * y + 6.0 * p2 * x
    along_y = radial + yy * slope + 6.0 * p1 * y + 2.0 * p2 * x
    across = xy * slope + 2.0 * (p1 * x + p2 * y)
    return torch.stack([bent_x, bent_y], dim=-1), (along_x, across, along_y)


@with_kernel("lenses.cpu")
def undistort(
    plane: Float[Tensor, "*points 2"], lens: Float[Tensor, "*#points 6"], newton_steps: int
) -> Float[Tensor, "*points 2"]:
    """Return the undistorted positions that a radial and tangential lens shows at positions in the plane."""
    # Newton's iteration in two dimensions. Starting at the distorted point, it cannot overshoot for a lens that bends
    # one way only (barrel: from below a concave function; pincushion: from above a convex one).
    found = plane
    for _ in range(newton_steps):
        bent, (along_x, across, along_y) = _distorted(found, lens)
        off_x, off_y = (bent - plane).unbind(dim=-1)
        step_x, step_y = along_y * off_x - across * off_y, along_x * off_y - across * off_x
        determinant = along_x * along_y - across.square()
        found = found - torch.stack([step_x, step_y], dim=-1) / determinant[..., None]
    return found


def _angle_at(radius: Tensor, lens: Tensor) -> Tensor:
    # The angle from the axis that a fisheye shows at a radius: Newton's iteration.
    angle = radius
    for _ in range(NEWTON_STEPS):
        square = angle.square()
        factor, slope = _even_polynomial(square, lens)
        angle = angle - (angle * factor - radius) / (factor + square * slope)
    return angle
