"""Renders whose colors are fitted to photographs: the remaining error is not due to exposure or white balance.

It is off by default: `colors` in conf/evaluation/default.yaml.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.rendering.background import in_other_light
from nerf_lightning.nerf.rendering.linear_light import scale_light
from nerf_lightning.nerf.row_chunks import row_chunks

FEWEST = 8  # Fewer pixels than this are not fitted
HALF_A_LEVEL = 0.5 / 255


@disable_autocast
def color_corrected(
    render: Float[Tensor, "height width 3"],
    truth: Float[Tensor, "height width 3"],
    mask: Bool[Tensor, "height width"] | None = None,
) -> Float[Tensor, "height width 3"]:
    """Return A c + b for each color c of a render, with the A (3 x 3) and b of least squared error.

    This is the fit of multinerf and gsplat (`cc_psnr`): affine, in encoded colors.

    Args:
        render: the picture to judge.
        truth: the photograph.
        mask: pixels that count; None: all. Fewer than 8 leave the render as it is.
    """

    def counted(picture: Tensor, rows: slice) -> Tensor:
        return (picture[rows] if mask is None else picture[rows][mask[rows]]).double().reshape(-1, 3)

    count = render[..., 0].numel() if mask is None else int(mask.sum())
    if count < FEWEST:
        return render
    parts = list(row_chunks(*render.shape[:2]))
    sums = (torch.stack([counted(each, rows).sum(dim=0) for rows in parts]).sum(0) for each in (render, truth))
    at, to = (total / count for total in sums)
    # About the means, and by the pseudoinverse: for a picture of one color, only its mean is fitted.
    squares, products = torch.zeros(2, 3, 3, dtype=torch.float64, device=render.device)
    for rows in parts:
        spread = counted(render, rows) - at
        squares += spread.T @ spread
        products += spread.T @ (counted(truth, rows) - to)
    matrix = torch.linalg.pinv(squares, rtol=1e-9, hermitian=True) @ products
    corrected = torch.empty_like(render)
    for rows in parts:
        corrected[rows] = (render[rows].double() - at) @ matrix + to
    return corrected


def is_one_color(picture: Float[Tensor, "height width 3"], mask: Bool[Tensor, "height width"] | None = None) -> bool:
    """Return whether the pixels that count, if any, differ by less than half a level of 255 in every channel."""
    colors = picture.reshape(-1, 3) if mask is None else picture[mask]
    return not len(colors) or bool((colors.amax(dim=0) - colors.amin(dim=0) < HALF_A_LEVEL).all())


def exposure_fitted(
    render: Float[Tensor, "height width 3"],
    truth: Float[Tensor, "height width 3"],
    opacity: Float[Tensor, "height width"],
    fitted: Bool[Tensor, "height width"],
    background: Float[Tensor, "1 3"] | None,
) -> Float[Tensor, "height width 3"]:
    """Return a render with the exposure and white balance that bring some of its pixels closest to its photograph.

    One gain on linear light per channel, as `correction=exposure` gives a training photograph; the background, which no
    camera saw, keeps its color.

    Args:
        render: the picture to judge.
        truth: the photograph.
        opacity: of each pixel of the render.
        fitted: pixels that are compared; if there are none, the render is unchanged.
        background: the color behind the render; None: no background.
    """
    if not bool(fitted.any()):
        return render

    foreground = render if background is None else render - (1.0 - opacity[..., None]) * background

    def exposed(stops: Tensor, *parts: Tensor) -> Tensor:
        return in_other_light(lambda straight: scale_light(straight, torch.exp2(stops)), *parts)

    stops = torch.zeros(3, device=render.device, requires_grad=True)
    ours, true = (render[fitted], foreground[fitted], opacity[fitted]), truth[fitted]
    optimizer = torch.optim.LBFGS([stops], max_iter=50, tolerance_grad=1e-9, line_search_fn="strong_wolfe")

    def error() -> float:
        optimizer.zero_grad()
        squared = (exposed(stops, *ours) - true).square().mean()
        squared.backward()
        return float(squared.detach())

    with torch.enable_grad():
        optimizer.step(error)
    return exposed(stops.detach(), render, foreground, opacity)
