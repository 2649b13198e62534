"""Splat files: PLY as in 3DGS, SPZ 3 (Niantic), SOG 2 (PlayCanvas), USDA, and glTF (KHR_gaussian_splatting).

Each is written atomically. The axes of PLY and SOG are right, down, front; those of the others are right, up, back, so
y and z are negated there.
"""

import json
import math
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.extensions.splats.gaussians import TURN, Gaussians
from nerf_lightning.extensions.splats.sog import write_sog
from nerf_lightning.extensions.splats.usd import write_usda
from nerf_lightning.files.atomic import whole_file
from nerf_lightning.messages.errors import require_extra
from nerf_lightning.nerf.encoders.spherical_harmonics import DEGREE_1, SphericalHarmonicsEncoder
from nerf_lightning.nerf.geometry.alignment import carried
from nerf_lightning.nerf.geometry.poses import quaternion_from_rotation, rotation_from_quaternion
from nerf_lightning.nerf.geometry.world_frame import points_to_user, unit_of
from nerf_lightning.nerf.types.scene import Cameras

SplatFormat = Literal["ply", "spz", "sog", "glb", "usda"]
IN_METERS = ("glb", "usda")
"""Formats that define their unit and up."""
FINE = 0.05  # SPZ's positions are integer multiples of a step, at most this share of the splats' median size.
LARGEST_PLACE = 1 << 23  # Maximum number of steps from the origin.
HALF_TURN = torch.diag(torch.cat([TURN, torch.ones(1)])).double()


def moved(gaussians: Gaussians, matrix: Float[Tensor, "4 4"]) -> Gaussians:
    """Transform splats by a similarity (float64): positions, sizes, axes and colors."""
    unit = unit_of(matrix)
    rotation = matrix[:3, :3] / unit
    axes = rotation @ rotation_from_quaternion(gaussians.quaternions.double())
    return Gaussians(
        points_to_user(gaussians.means.double(), matrix),
        gaussians.log_scales + math.log(unit),
        quaternion_from_rotation(axes).float(),
        gaussians.opacity_logits,
        gaussians.sh_dc,
        turned_harmonics(gaussians.sh_rest, rotation),
    )


def turned_harmonics(
    sh_rest: Float[Tensor, "n coefficients 3"], rotation: Float[Tensor, "3 3"]
) -> Float[Tensor, "n coefficients 3"]:
    """Return the coefficients of the same colors in a rotated frame.

    The harmonics of a degree transform among themselves: Y(R^T d) = Y(d) M for every direction d. Here M is the
    least-squares solution for more directions than harmonics, which is exact.
    """
    count = sh_rest.shape[1]
    if not count:
        return sh_rest
    directions = normalize(torch.randn(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=-1)
    encoder = SphericalHarmonicsEncoder(math.isqrt(count + 1))
    new, old = encoder(directions)[:, 1:], encoder(directions @ rotation.double())[:, 1:]
    matrix = torch.linalg.lstsq(new, old).solution
    return torch.einsum("jk,nkc->njc", matrix, sh_rest.double()).to(sh_rest)


def save_splats(path: Path, gaussians: Gaussians, cameras: Cameras | None = None) -> None:
    """Write splats in the format of the file's name: .ply, .spz, .sog, .glb or .usda.

    Args:
        path: the file.
        gaussians: splats with axes right, down, front.
        cameras: in the same frame, for formats with cameras; None: none are written.
    """
    with whole_file(path) as part:
        if path.suffix == ".ply":
            part.write_bytes(ply_bytes(gaussians))
        elif path.suffix == ".sog":
            write_sog(part, gaussians)
        elif path.suffix == ".spz":
            write_spz(part, moved(gaussians, HALF_TURN))
        elif path.suffix == ".usda":
            seen = None if cameras is None else moved_cameras(cameras, HALF_TURN)
            write_usda(part, moved(gaussians, HALF_TURN), seen)
        else:
            part.write_bytes(glb_bytes(moved(gaussians, HALF_TURN)))


def moved_cameras(cameras: Cameras, matrix: Float[Tensor, "4 4"]) -> Cameras:
    """Transform cameras by a similarity (float64)."""
    return replace(cameras, c2w=carried(cameras.c2w, matrix))


def ply_bytes(gaussians: Gaussians) -> bytes:
    """Return a file as in 3DGS: one row of floats per splat, all before their activations."""
    rest = gaussians.sh_rest.shape[1]
    names = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{c}" for c in range(3)), *(f"f_rest_{k}" for k in range(3 * rest))]
    names += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    columns = [
        *(gaussians.means, torch.zeros(len(gaussians), 3), gaussians.sh_dc),
        gaussians.sh_rest.mT.flatten(1),  # all of red, then green, then blue
        *(gaussians.opacity_logits[:, None], gaussians.log_scales, normalize(gaussians.quaternions, dim=-1)),
    ]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(gaussians)}"]
    header += [*(f"property float {name}" for name in names), "end_header\n"]
    return "\n".join(header).encode() + _floats(torch.cat([each.double() for each in columns], dim=1)).tobytes()


def write_spz(path: Path, splats: Gaussians) -> None:
    """Write SPZ 3 by gsply, which writes numbers unchanged."""
    gsply = require_library()
    size = splats.log_scales.amax(dim=1).exp().median()
    farthest = float(splats.means.abs().max().clamp(min=1e-6))
    bits = math.ceil(-math.log2(FINE * float(size)))
    bits = max(1, min(bits, math.floor(math.log2((LARGEST_PLACE - 1) / farthest)), 23))
    data = gsply.GSData(
        means=_floats(splats.means),
        scales=_floats(splats.log_scales),
        quats=_floats(splats.quaternions),
        opacities=_floats(splats.opacity_logits),
        sh0=_floats(splats.sh_dc),
        shN=_floats(_coarse(splats.sh_rest)),
    )
    require_library("gsply.spz").write_spz(path, data, version=3, fractional_bits=bits)


def _coarse(sh_rest: Float[Tensor, "n coefficients 3"]) -> Float[Tensor, "n coefficients 3"]:
    # 5 bits for degree 1 and 4 for the others, as in the format's own program: gzip halves that.
    steps = torch.tensor([16.0] * 3 + [8.0] * (sh_rest.shape[1] - 3))[: sh_rest.shape[1], None]
    return (sh_rest * steps).round() / steps


def glb_bytes(gaussians: Gaussians) -> bytes:
    """Return binary glTF: a point primitive whose attributes are the splats', after their activations."""
    prefix, rest = "KHR_gaussian_splatting:", gaussians.sh_rest
    attributes = {
        "POSITION": gaussians.means,
        "COLOR_0": torch.cat(
            [(0.5 + DEGREE_1 * gaussians.sh_dc).clamp(0, 1), gaussians.opacity_logits.sigmoid()[:, None]], dim=1
        ),
        f"{prefix}ROTATION": normalize(gaussians.quaternions, dim=-1)[:, [1, 2, 3, 0]],
        f"{prefix}SCALE": gaussians.log_scales.exp(),
        f"{prefix}OPACITY": gaussians.opacity_logits.sigmoid(),
        f"{prefix}SH_DEGREE_0_COEF_0": gaussians.sh_dc,
    }
    for degree in range(1, gaussians.sh_degree + 1):
        for k in range(2 * degree + 1):
            attributes[f"{prefix}SH_DEGREE_{degree}_COEF_{k}"] = rest[:, degree * degree - 1 + k]
    arrays = [_floats(each) for each in attributes.values()]
    sizes = [array.nbytes for array in arrays]
    starts = np.cumsum([0, *sizes]).tolist()
    kinds = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
    accessors: list[dict[str, Any]] = [
        {"bufferView": k, "componentType": 5126, "count": len(a), "type": kinds[1 if a.ndim == 1 else a.shape[1]]}
        for k, a in enumerate(arrays)
    ]
    accessors[0] |= {"min": arrays[0].min(axis=0).tolist(), "max": arrays[0].max(axis=0).tolist()}
    splatting = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    splatting |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    primitive = {
        "mode": 0,
        "attributes": {name: k for k, name in enumerate(attributes)},
        "extensions": {"KHR_gaussian_splatting": splatting},
    }
    tree = {
        "asset": {"version": "2.0", "generator": "nerf-lightning"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": at, "byteLength": size} for at, size in zip(starts, sizes, strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", starts[-1], b"BIN\0")
    return (
        struct.pack("<4sII", b"glTF", 2, 12 + len(chunks) + starts[-1]) + chunks + b"".join(a.tobytes() for a in arrays)
    )


def require_library(module: str = "gsply") -> Any:
    """Return gsply, or report how to install it."""
    return require_extra(module, "splats", "Exporting splats as SPZ (what.format=spz)")


def _floats(tensor: Tensor) -> Float[ndarray, "*n"]:
    return np.ascontiguousarray(tensor.detach().numpy(), dtype="<f4")
