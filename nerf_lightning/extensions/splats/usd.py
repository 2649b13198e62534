"""OpenUSD 26.03's ParticleField3DGaussianSplat, as text (USDA), with the capture's cameras.

https://openusd.org/release/user_guides/schemas/usdVol/ParticleField3DGaussianSplat.html. Axes are right, up, back.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.extensions.splats.gaussians import Gaussians
from nerf_lightning.nerf.types.scene import Cameras

SENSOR = 36.0
"""Width of a camera's sensor; USD's lenses are in tenths of a scene unit, and only ratios count."""
REACH = 3.0  # Standard deviations of a splat that are in the extent.

STAGE = """#usda 1.0
(
    defaultPrim = "Scene"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "Scene"
{{
    def ParticleField3DGaussianSplat "Splats"
    {{
        float3[] extent = {extent}
        point3f[] positions = {positions}
        quatf[] orientations = {orientations}
        float3[] scales = {scales}
        float[] opacities = {opacities}
        uniform int radiance:sphericalHarmonicsDegree = {degree}
        float3[] radiance:sphericalHarmonicsCoefficients = {coefficients}
        uniform token projectionModeHint = "perspective"
        uniform token sortingModeHint = "cameraDistance"
    }}

    def Scope "Cameras"
    {{
{cameras}
    }}
}}
"""
CAMERA = """        def Camera "View_{number:04d}" (
            displayName = "View {number}"
        )
        {{
            float focalLength = {focal:.7g}
            float horizontalAperture = {width:.7g}
            float verticalAperture = {height:.7g}
            float2 clippingRange = (0.001, 1000000)
            float horizontalApertureOffset = {right:.7g}
            float verticalApertureOffset = {up:.7g}
            matrix4d xformOp:transform = ({rows})
            uniform token[] xformOpOrder = ["xformOp:transform"]
        }}"""


def write_usda(path: Path, splats: Gaussians, cameras: Cameras | None) -> None:
    """Write splats and pinhole cameras, whose axes are right, up, back.

    Args:
        path: the file.
        splats: in the frame of the stage.
        cameras: in the same frame, of which focal length and center are written, not distortion; None: none.
    """
    deviations = splats.log_scales.exp()
    reach = REACH * deviations.amax(dim=1, keepdim=True)
    extent = torch.stack([(splats.means - reach).amin(dim=0), (splats.means + reach).amax(dim=0)])
    # Each splat's harmonics follow one another.
    coefficients = torch.cat([splats.sh_dc[:, None], splats.sh_rest.to(splats.sh_dc)], dim=1).flatten(0, 1)
    text = STAGE.format(
        extent=_tuples(extent),
        positions=_tuples(splats.means),
        orientations=_tuples(normalize(splats.quaternions, dim=-1)),
        scales=_tuples(deviations),
        opacities=f"[{', '.join(map(_number, splats.opacity_logits.sigmoid().tolist()))}]",
        degree=splats.sh_degree,
        coefficients=_tuples(coefficients),
        cameras="" if cameras is None else "\n".join(_camera(cameras, view) for view in range(len(cameras.c2w))),
    )
    path.write_text(text, encoding="utf-8")


def _camera(cameras: Cameras, view: int) -> str:
    width, height = int(cameras.width[view]), int(cameras.height[view])
    pixel = SENSOR / width
    (fx, _), (cx, cy) = cameras.focal[view].tolist(), cameras.center[view].tolist()
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3] = cameras.c2w[view].double()
    return CAMERA.format(
        number=view,
        focal=pixel * fx,
        width=SENSOR,
        height=pixel * height,
        # The window moves to where the principal point is not.
        right=pixel * (width / 2 - cx),
        up=pixel * (cy - height / 2),
        rows=", ".join(_tuple(row) for row in matrix.T.tolist()),  # USD's vectors are rows
    )


def _tuples(rows: Float[Tensor, "n k"]) -> str:
    return f"[{', '.join(map(_tuple, rows.tolist()))}]"


def _tuple(row: Sequence[float]) -> str:
    return f"({', '.join(map(_number, row))})"


def _number(value: float) -> str:
    return f"{value:.7g}"
