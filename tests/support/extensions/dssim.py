"""The structural dissimilarity of squares of pixels, (1 - SSIM) / 2 (Wang et al. 2004)."""

import torch

from nerf_lightning.nerf.losses.base import Loss

C1, C2 = 0.01**2, 0.03**2


class DSSIM(Loss):
    def __init__(self, patch: int = 4):
        super().__init__()
        self.patch = patch

    def forward(self, renderings, target):
        squares = len(target.rgb) // self.patch**2
        weight = target.weight[: squares * self.patch**2].view(squares, -1).amin(dim=1)

        def of_level(rgb):
            a, b = (each[: squares * self.patch**2].view(squares, -1, 3) for each in (rgb, target.rgb))
            mean_a, mean_b = a.mean(dim=1), b.mean(dim=1)
            covariance = ((a - mean_a[:, None]) * (b - mean_b[:, None])).mean(dim=1)
            variances = a.var(dim=1, unbiased=False) + b.var(dim=1, unbiased=False)
            luminance = (2 * mean_a * mean_b + C1) / (mean_a.square() + mean_b.square() + C1)
            ssim = luminance * (2 * covariance + C2) / (variances + C2)
            return (0.5 * (1.0 - ssim).mean(dim=1) * weight).mean()

        return {"dssim": torch.stack([of_level(each.rgb) for each in renderings])}
