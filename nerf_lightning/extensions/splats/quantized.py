"""Splats as bytes of a page, a tenth of a PLY.

Each plane has bytes of one kind, so that gzip compresses them well: means as floats without their last byte, logarithms
of standard deviations, unit quaternions, opacity, colors of degree 0, and the other harmonics. `page_files/splats.js`
reads them.
"""

import gzip
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.extensions.splats.gaussians import Gaussians, dc_of_color
from nerf_lightning.nerf.encoders.spherical_harmonics import DEGREE_1

MOST_NATS = 12.0  # Between the largest and the smallest standard deviation: smaller ones are narrower than a pixel.
COLORS = (-0.5, 1.5)
RARE = 0.001  # Share of the harmonics that is clipped.
COARSE = 4  # Byte steps per step of a harmonic: gzip halves their size.
LARGEST = 127 // COARSE * COARSE


@dataclass(frozen=True)
class QuantizedSplats:
    """Bytes and their scales."""

    splats: int
    degree: int
    scales: tuple[float, float]
    """Values of bytes 0 and 255 of the logarithms of standard deviations,"""
    colors: tuple[float, float]
    """those of colors,"""
    harmonics: float
    """and of 128 + `LARGEST` of the other harmonics, of which 128 is 0."""
    content: UInt8[ndarray, "planes splats"]

    @classmethod
    def of(cls, gaussians: Gaussians) -> "QuantizedSplats":
        """Quantize splats with finite numbers."""
        largest = float(gaussians.log_scales.max())
        scales = max(float(gaussians.log_scales.min()), largest - MOST_NATS), largest
        rest = gaussians.sh_rest.flatten(1).numpy()
        harmonics = float(np.quantile(np.abs(rest), 1 - RARE)) if rest.size else 0.0
        words = np.ascontiguousarray(gaussians.means.numpy(), "<f4").view("<u4") + 0x80
        quaternions = 127 * normalize(gaussians.quaternions, dim=-1).numpy()
        steps = LARGEST / COARSE * np.clip(rest / max(harmonics, 1e-12), -1, 1)
        planes = [
            *((words >> shift).astype(np.uint8) for shift in (8, 16, 24)),
            _bytes(gaussians.log_scales.numpy(), *scales),
            _bytes(gaussians.opacity_logits.sigmoid()[:, None].numpy(), 0.0, 1.0),
            _bytes((0.5 + DEGREE_1 * gaussians.sh_dc).numpy(), *COLORS),
            (128 + quaternions.round()).astype(np.uint8),
            (128 + COARSE * steps.round()).astype(np.uint8),
        ]
        content = np.ascontiguousarray(np.concatenate(planes, axis=1).T)
        return cls(len(gaussians), gaussians.sh_degree, scales, COLORS, harmonics, content)

    def described(self) -> dict[str, Any]:
        """Return what a page needs besides the bytes."""
        return {name: value for name, value in asdict(self).items() if name != "content"}

    def packed(self) -> bytes:
        """Return the bytes compressed by gzip."""
        return gzip.compress(self.content.tobytes(), compresslevel=9, mtime=0)

    def gaussians(self) -> Gaussians:
        """Return the splats that a page shows."""
        low, middle, high, scales, opacity, colors, quaternions, rest = np.split(
            self.content.T, np.cumsum([3, 3, 3, 3, 1, 3, 4]), axis=1
        )
        words = sum(part.astype("<u4") << shift for part, shift in ((low, 8), (middle, 16), (high, 24)))
        harmonics = (rest.astype(np.float32) - 128) * self.harmonics / LARGEST
        return Gaussians(
            torch.from_numpy(np.ascontiguousarray(words).view("<f4")),
            _values(scales, *self.scales),
            torch.from_numpy(quaternions.astype(np.float32) - 128) / 127,
            _values(opacity[:, 0], 0.0, 1.0).clamp(1e-6, 1 - 1e-6).logit(),
            dc_of_color(_values(colors, *self.colors)),
            torch.from_numpy(harmonics).unflatten(1, (-1, 3)) if rest.size else torch.zeros(self.splats, 0, 3),
        )


def _bytes(values: Float[ndarray, "n k"], low: float, high: float) -> UInt8[ndarray, "n k"]:
    share = (values - low) / max(high - low, 1e-12)
    return np.asarray((255 * np.clip(share, 0, 1)).round().astype(np.uint8))


def _values(planes: UInt8[ndarray, "*n"], low: float, high: float) -> Float[Tensor, "*n"]:
    return low + (high - low) / 255 * torch.from_numpy(planes.astype(np.float32))
