"""How close a render is to a photograph: PSNR and SSIM of one image, and their mean over images.

Papers average the PSNR of each image. Pooling the squared error over images first gives a lower number.
The equation of the PSNR, and its maximum: `nerf/psnr.py`.
"""

import statistics
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from nerf_lightning.evaluation.color_fit import color_corrected, is_one_color
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.psnr import picture_psnr
from nerf_lightning.nerf.row_chunks import row_chunks

SSIM_SIGMA = 1.5
SSIM_WINDOW = 2 * int(3.5 * SSIM_SIGMA + 0.5) + 1
"""Width in pixels of the Gaussian window that torchmetrics uses for a standard deviation of SSIM_SIGMA pixels: 11."""
HIGHER_IS_BETTER = ("psnr", "cc_psnr", "ssim")
"""The other metrics are errors: lower is better."""


def masked_out(
    render: Float[Tensor, "height width 3"],
    truth: Float[Tensor, "height width 3"],
    mask: Bool[Tensor, "height width"] | None,
) -> Float[Tensor, "height width 3"]:
    """Return the render with the truth's colors outside the mask, so that there is no difference there."""
    return render if mask is None else torch.where(mask[..., None], render, truth)


@disable_autocast
def image_metrics(
    render: Float[Tensor, "height width 3"],
    truth: Float[Tensor, "height width 3"],
    mask: Bool[Tensor, "height width"] | None = None,
) -> dict[str, float | None]:
    """Return `psnr` (dB), `cc_psnr` and `ssim` of one image; the render is clamped to [0, 1] first.

    `cc_psnr` is the PSNR after an affine fit of the render's colors to the photograph's (`color_fit`), so that neither
    exposure nor white balance counts. It is None if either has only one color: a fit then says nothing.

    SSIM is torchmetrics' (Gaussian window, data range 1), which differs from scikit-image's in the third digit. It is
    None if the image is smaller than the window: with another window it would be another metric.

    Args:
        render: the picture to judge.
        truth: the photograph.
        mask: pixels that count, at least one; None: all. PSNR is over these pixels. For SSIM, which depends on
            neighbors, the others take the photograph's colors.
    """
    render = masked_out(render.clamp(0, 1), truth, mask)
    fits = not (is_one_color(render, mask) or is_one_color(truth, mask))
    return {
        "psnr": picture_psnr(render, truth, mask),
        "cc_psnr": picture_psnr(color_corrected(render, truth, mask).clamp_(0, 1), truth, mask) if fits else None,
        "ssim": _similarity(render, truth) if min(render.shape[:2]) >= SSIM_WINDOW else None,
    }


def _similarity(render: Float[Tensor, "height width 3"], truth: Float[Tensor, "height width 3"]) -> float:
    # torchmetrics' mean over all windows, including those that cross the border, in chunks of window centers.
    height, reach, total = render.shape[0], SSIM_WINDOW // 2, 0.0
    for rows in row_chunks(height, render.shape[1]):
        top, bottom = max(0, rows.start - reach), min(height, max(rows.stop + reach, SSIM_WINDOW))
        ours, true = (picture[top:bottom].movedim(-1, 0)[None] for picture in (render, truth))
        _, each = structural_similarity_index_measure(
            ours, true, sigma=SSIM_SIGMA, data_range=1.0, return_full_image=True
        )
        assert isinstance(each, Tensor)
        total += float(each[..., rows.start - top : rows.stop - top, :].mean()) * (rows.stop - rows.start)
    return total / height


def mean_over_images(per_image: Sequence[dict[str, float | None]]) -> dict[str, float | None]:
    """Return each metric's mean over images; None if an image lacks it, since a mean over the others would mislead."""
    return {name: None if known is None else sum(known) / len(known) for name, known in _columns(per_image).items()}


def median_over_images(per_image: Sequence[dict[str, float | None]]) -> dict[str, float | None]:
    """Return each metric's median over images; None if an image lacks it."""
    return {name: None if known is None else statistics.median(known) for name, known in _columns(per_image).items()}


def worst_of_images(per_image: Sequence[dict[str, float | None]]) -> dict[str, int | None]:
    """Return which image is worst by each metric; None if an image lacks it.

    >>> worst_of_images([{"psnr": 30.0, "lpips": 0.1}, {"psnr": 20.0, "lpips": 0.3}])
    {'psnr': 1, 'lpips': 1}
    """
    return {
        name: None if known is None else known.index(min(known) if name in HIGHER_IS_BETTER else max(known))
        for name, known in _columns(per_image).items()
    }


def _columns(per_image: Sequence[dict[str, float | None]]) -> dict[str, list[float] | None]:
    if not per_image:
        raise ValueError("there is no image to average over")
    columns = {name: [image[name] for image in per_image] for name in per_image[0]}
    known = {name: [value for value in values if value is not None] for name, values in columns.items()}
    return {name: known[name] if len(known[name]) == len(columns[name]) else None for name in columns}
