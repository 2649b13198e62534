"""Real spherical harmonics of a direction: a few smooth functions on the sphere.

`kernels/spherical_harmonics/cuda.py` repeats the formulas, for splats `extensions/splats/projection.py` and
`page_files/splats.vert` there.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.encoders.base import Encoder
from nerf_lightning.nerf.kernels.backends import with_kernel

# Normalized so that the integral of each squared function over the sphere is one (Condon-Shortley phase included).
DEGREE_1 = 0.28209479177387814  # 1 / (2 sqrt(pi))
DEGREE_2 = 0.4886025119029199  # sqrt(3 / (4 pi))
DEGREE_3 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
DEGREE_4 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


class SphericalHarmonicsEncoder(Encoder):
    """The real spherical harmonics Y_lm with l below `degree`: degree^2 features, for directions of unit length.

    Args:
        degree: 1 to 4; 4 as in arXiv 2201.05989.
    """

    def __init__(self, degree: int = 4):
        super().__init__()
        if not 1 <= degree <= 4:
            raise ValueError(f"degree={degree}: 1, 2, 3 or 4")
        self.degree = degree

    @property
    def out_dim(self) -> int:
        """degree^2."""
        return self.degree**2

    def forward(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points features"]:
        """Return Y_00, Y_1-1, Y_10, Y_11, Y_2-2, ..."""
        return spherical_harmonics(points, self.degree)

    def reset_parameters(self) -> None:
        """Do nothing: there are no parameters."""


@with_kernel("spherical_harmonics.cuda")
def spherical_harmonics(points: Float[Tensor, "*points 3"], degree: int) -> Float[Tensor, "*points features"]:
    """Return Y_00, Y_1-1, Y_10, Y_11, Y_2-2, ... of unit directions."""
    x, y, z = points.movedim(-1, 0).contiguous()
    columns = [torch.full_like(x, DEGREE_1)]
    if degree > 1:
        columns += [-DEGREE_2 * y, DEGREE_2 * z, -DEGREE_2 * x]
    if degree > 2:
        a, b, c = DEGREE_3
        columns += [a * x * y, -a * y * z, b * (3 * z * z - 1), -a * x * z, c * (x * x - y * y)]
    if degree > 3:
        columns += _degree_4(x, y, z)
    return torch.stack(columns).movedim(0, -1).contiguous()  # stacked contiguously, then transposed: twice as fast


def _degree_4(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    a, b, c, d, e = DEGREE_4
    xx, yy, zz = x * x, y * y, z * z
    return [
        -a * y * (3 * xx - yy),
        b * x * y * z,
        -c * y * (5 * zz - 1),
        d * z * (5 * zz - 3),
        -c * x * (5 * zz - 1),
        e * z * (xx - yy),
        -a * x * (xx - 3 * yy),
    ]
