"""SOG 2, PlayCanvas's format for the web: splats as lossless WebP pictures, one pixel a splat, in a ZIP.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog. Its axes are those of a PLY, as in
the files of splat-transform: right, down, front.
"""

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Int64, UInt8
from numpy import ndarray
from PIL import Image
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.extensions.splats.gaussians import Gaussians

CODES = 256
"""Values of a codebook: a byte names one."""
ROUNDS, PALETTE_ROUNDS = 10, 4  # Of Lloyd's algorithm.
PALETTE, MOST_PALETTE, ROW = 1024, 1 << 12, 64
"""Colors that depend on the direction are one of a palette's for every few splats: at least, at most, in a row."""
SHARED = 4
ALIKE = 1 << 12  # Splats that are compared with the palette at once.
LARGEST_QUATERNION = 252
"""The alpha of a quaternion whose first number is the largest."""


def write_sog(path: Path, splats: Gaussians) -> None:
    """Write splats, whose axes are right, down, front."""
    splats = splats.map(lambda each: each[morton_order(splats.means)])
    means, mins, maxs = _words(splats.means)
    scales, scale_codes = _codes(splats.log_scales)
    colors, color_codes = _codes(splats.sh_dc)
    opacities = 255 * splats.opacity_logits.sigmoid()[:, None]
    pictures = {
        "means_l": means & 255,
        "means_u": means >> 8,
        "scales": scales,
        "quats": _smallest_three(splats.quaternions),
        "sh0": torch.cat([colors, opacities.round().long()], dim=1),
    }
    about: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "nerf_lightning"},
        "count": len(splats),
        "means": {"mins": mins, "maxs": maxs, "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_codes, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_codes, "files": ["sh0.webp"]},
    }
    width = 4 * math.ceil(math.sqrt(len(splats)) / 4)
    webps = {name: _webp(_picture(pixels, width)) for name, pixels in pictures.items()}
    if splats.sh_degree:
        palette, labels = _palette(splats.sh_rest.flatten(1))
        indices, codes = _codes(palette)
        about["shN"] = {"count": len(palette), "bands": splats.sh_degree, "codebook": codes}
        about["shN"]["files"] = ["shN_centroids.webp", "shN_labels.webp"]
        webps["shN_centroids"] = _webp(_picture(indices.reshape(-1, 3), ROW * splats.sh_rest.shape[1]))
        webps["shN_labels"] = _webp(_picture(torch.stack([labels & 255, labels >> 8, 0 * labels], dim=1), width))
    with zipfile.ZipFile(path, "w") as bundle:  # stored as they are: WebP is compressed
        for name, content in webps.items():
            bundle.writestr(f"{name}.webp", content)
        bundle.writestr("meta.json", json.dumps(about))


def morton_order(means: Float[Tensor, "n 3"]) -> Int64[Tensor, "n"]:
    """Return the order in which neighbors in space are neighbors in the pictures, which compresses them well."""
    low, high = means.amin(dim=0), means.amax(dim=0)
    cells = (1023 * (means - low) / (high - low).clamp(min=1e-12)).long()
    bits = torch.arange(10)
    codes = ((cells[:, None, :] >> bits[:, None]) & 1) << (3 * bits[:, None] + torch.arange(3))
    return codes.sum(dim=(1, 2)).argsort(stable=True)


def _words(means: Float[Tensor, "n 3"]) -> tuple[Int64[Tensor, "n 3"], list[float], list[float]]:
    """Return places as words of 16 bits on a scale that is fine at the origin, and where each axis begins and ends."""
    scaled = means.double().sign() * means.double().abs().log1p()
    low, high = scaled.amin(dim=0), scaled.amax(dim=0)
    words = (65535 * (scaled - low) / (high - low).clamp(min=1e-12)).round().long()
    return words, low.tolist(), high.tolist()


def _smallest_three(quaternions: Float[Tensor, "n 4"]) -> Int64[Tensor, "n 4"]:
    """Return the three smaller numbers of unit quaternions (w x y z) as bytes, and which one is left out."""
    unit = normalize(quaternions, dim=-1)
    largest = unit.abs().argmax(dim=1)
    unit = unit * unit.gather(1, largest[:, None]).sign()  # q and -q turn alike
    others = torch.arange(4).expand_as(unit)[torch.arange(4) != largest[:, None]].reshape(-1, 3)
    smaller = unit.gather(1, others) * math.sqrt(2.0)  # none is beyond 1 / sqrt(2)
    codes = (127.5 * (smaller + 1.0)).round().long().clamp(0, 255)
    return torch.cat([codes, LARGEST_QUATERNION + largest[:, None]], dim=1)


def _codes(values: Float[Tensor, "n k"]) -> tuple[Int64[Tensor, "n k"], list[float]]:
    """Return values as indices into a codebook that Lloyd's algorithm finds for all of them, and the codebook."""
    ordered = values.double().flatten().sort().values.numpy()
    shares = (np.arange(CODES) + 0.5) / CODES
    # Between as many values for each code and as wide steps: the few outermost are not forgotten.
    even = ordered[0] + (ordered[-1] - ordered[0]) * shares
    codes = 0.25 * np.quantile(ordered, shares) + 0.75 * even
    for _ in range(ROUNDS):  # of sorted values, those nearest to a code stand between two middles
        ends = np.searchsorted(ordered, (codes[1:] + codes[:-1]) / 2)
        parts = np.split(ordered, ends)
        codes = np.array([part.mean() if len(part) else code for part, code in zip(parts, codes, strict=True)])
    middles = torch.from_numpy((codes[1:] + codes[:-1]) / 2)
    return torch.searchsorted(middles, values.double().contiguous()), codes.tolist()


def _palette(rows: Float[Tensor, "n k"]) -> tuple[Float[Tensor, "palette k"], Int64[Tensor, "n"]]:
    """Return rows of which each stands for some of the given ones (k-means), and which one stands for each."""
    size = min(len(rows), MOST_PALETTE, max(PALETTE, len(rows) // SHARED))
    palette = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[:size]]
    labels = _nearest(rows, palette)
    for _ in range(PALETTE_ROUNDS):
        count = torch.bincount(labels, minlength=size)[:, None]
        sums = torch.zeros_like(palette).index_add_(0, labels, rows)
        palette = torch.where(count > 0, sums / count.clamp(min=1), palette)
        labels = _nearest(rows, palette)
    return palette, labels


def _nearest(rows: Float[Tensor, "n k"], palette: Float[Tensor, "palette k"]) -> Int64[Tensor, "n"]:
    half = 0.5 * palette.square().sum(dim=1)
    return torch.cat([(half - part @ palette.T).argmin(dim=1) for part in rows.split(ALIKE)])


def _picture(pixels: Int[Tensor, "n channels"], width: int) -> UInt8[ndarray, "height width channels"]:
    """Return pixels in rows; what is left of the last row is 0."""
    rows = math.ceil(len(pixels) / width)
    picture = torch.zeros(rows * width, pixels.shape[1], dtype=torch.uint8)
    picture[: len(pixels)] = pixels.to(torch.uint8)
    return np.asarray(picture.reshape(rows, width, -1).numpy())


def _webp(picture: UInt8[ndarray, "height width channels"]) -> bytes:
    buffer = io.BytesIO()
    # exact: the colors of transparent pixels are values, too.
    Image.fromarray(picture).save(buffer, format="WEBP", lossless=True, exact=True, quality=100)
    return buffer.getvalue()
