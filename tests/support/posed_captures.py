"""The same cameras written in every format that people have, and their rays read back."""

import json
import struct
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.readers.colmap import ColmapReader
from nerf_lightning.data.readers.llff import LlffReader
from nerf_lightning.data.readers.transforms import TransformsReader
from nerf_lightning.nerf.geometry.cameras import rays_through_pixels
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.geometry.world_frame import unit_of
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.nerf.types.scene import Scene

READERS: dict[str, type[CaptureReader]] = {"llff": LlffReader, "colmap": ColmapReader, "transforms": TransformsReader}
FLIP = np.diag([1.0, -1.0, -1.0])
NUMBERS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5}


def ring(count: int = 9, height: float = 1.5, radius: float = 4.0) -> np.ndarray:
    """Return poses on a circle that look at (0.3, -0.2, 0.1), z up."""
    angle = torch.linspace(0, 2 * torch.pi, count + 1, dtype=torch.float64)[:-1] + 0.2
    eyes = torch.stack([radius * angle.cos(), radius * angle.sin(), height + 0.3 * (3 * angle).sin()], dim=-1)
    target = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64).expand_as(eyes)
    return look_at(eyes, target, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)).numpy()


def wall(count: int = 9) -> np.ndarray:
    """Return poses of a forward-facing capture: a plane of cameras that look along +y, z up, at a wall 5 away."""
    place = torch.arange(count, dtype=torch.float64)
    eyes = torch.stack([0.3 * (place % 3 - 1), 0.05 * (place % 2), 0.3 * (place // 3 - 1)], dim=-1)
    target = 0.2 * eyes + torch.tensor([0.0, 5.0, 0.0], dtype=torch.float64)
    return look_at(eyes, target, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)).numpy()


@dataclass(frozen=True)
class Known:
    """A capture as it truly is; one camera for each view."""

    c2w: np.ndarray = field(default_factory=ring)
    names: tuple[str, ...] = ()
    size: tuple[int, int] = (16, 12)
    focal: tuple[float, float] = (20.0, 20.0)
    center: tuple[float, float] = (8.0, 6.0)
    points: np.ndarray = field(default_factory=lambda: np.random.default_rng(3).normal(0, 0.4, (60, 3)))
    camera: str = "PINHOLE"
    params: tuple[float, ...] = ()
    """What COLMAP's camera has; empty: from focal and center."""

    def __post_init__(self) -> None:
        if not self.names:
            object.__setattr__(self, "names", tuple(f"p_{view}.png" for view in range(len(self.c2w))))

    @property
    def colmap_params(self) -> tuple[float, ...]:
        return self.params or (*self.focal, *self.center)

    def w2c(self, view: int) -> np.ndarray:
        rotation = FLIP @ self.c2w[view, :, :3].T
        return np.concatenate([rotation, -rotation @ self.c2w[view, :, 3:]], axis=1)

    def moved(self, scale: float, rotation: np.ndarray, shift: np.ndarray) -> "Known":
        """Return the same capture in another frame of the user's."""
        centers = scale * self.c2w[:, :, 3] @ rotation.T + shift
        c2w = np.concatenate([rotation @ self.c2w[:, :, :3], centers[:, :, None]], axis=2)
        return replace(self, c2w=c2w, points=scale * self.points @ rotation.T + shift)


def photograph(view: int, width: int, height: int) -> np.ndarray:
    return np.random.default_rng(view).integers(0, 256, (height, width, 3), dtype=np.uint8)


def write_pictures(folder: Path, names: tuple[str, ...], size: tuple[int, int]) -> None:
    for view, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(photograph(view, *size)).save(folder / name)


def write_llff(root: Path, known: Known, folder: str = "images", hwf_times: float = 1.0, near: float = 1.0) -> Path:
    """Write rows in order of the names, as LLFF does."""
    write_pictures(root / folder, known.names, known.size)
    width, height = known.size
    rows = []
    for view in sorted(range(len(known.names)), key=lambda view: known.names[view]):
        right, up, back, center = known.c2w[view].T
        hwf = hwf_times * np.array([height, width, known.focal[0]])
        rows.append([*np.stack([-up, right, back, center, hwf], axis=1).ravel(), near, 9.0])
    np.save(root / "poses_bounds.npy", np.array(rows))
    return root


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return w, x, y, z: the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.diag([a - e - i, e - a - i, i - a - e, a + e + i])
    k[1:3, 0], k[2, 1], k[3, :3] = (d + b, g + c), h + f, (h - f, c - g, d - b)
    x, y, z, w = np.linalg.eigh(k, UPLO="L")[1][:, -1]
    return np.array([w, x, y, z])


def write_colmap(root: Path, known: Known, kind: str = ".bin", where: str = "sparse/0", pictures: bool = True) -> Path:
    """Write a model, binary or text; view i has camera i + 1, and image number i + 10."""
    if pictures:
        write_pictures(root / "images", known.names, known.size)
    folder = root / where
    folder.mkdir(parents=True, exist_ok=True)
    views = range(len(known.names))
    poses = [(*quaternion(known.w2c(view)[:, :3]), *known.w2c(view)[:, 3]) for view in views]
    (_write_binary if kind == ".bin" else _write_text)(folder, known, poses)
    return root


def _write_binary(folder: Path, known: Known, poses: list[tuple[float, ...]]) -> None:
    count, params = len(poses), known.colmap_params
    cameras, images = struct.pack("<Q", count), struct.pack("<Q", count)
    for view, pose in enumerate(poses):
        number = NUMBERS[known.camera]
        cameras += struct.pack(f"<IiQQ{len(params)}d", view + 1, number, *known.size, *params)
        images += struct.pack("<I7dI", view + 10, *pose, view + 1) + known.names[view].encode() + b"\0"
        images += struct.pack("<Q2dq", 1, 3.0, 4.0, -1)
    points = struct.pack("<Q", len(known.points))
    for number, point in enumerate(known.points):
        points += struct.pack("<Q3d3BdQ2I", number, *point, 9, 9, 9, 0.5, 1, 10, 0)
    for name, content in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.bin").write_bytes(content)


def _write_text(folder: Path, known: Known, poses: list[tuple[float, ...]]) -> None:
    def words(*values: object) -> str:
        return " ".join(repr(float(value)) if isinstance(value, float) else str(value) for value in values)

    cameras, images = ["# Camera list"], ["# Image list", "#   two lines each"]
    for view, pose in enumerate(poses):
        cameras.append(words(view + 1, known.camera, *known.size, *map(float, known.colmap_params)))
        images.append(words(view + 10, *map(float, pose), view + 1, known.names[view]))
        images.append("3.0 4.0 -1" if view % 2 else "")
    points = [words(number, *map(float, point), 9, 9, 9, 0.5, 10, 0) for number, point in enumerate(known.points)]
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def frames_of(known: Known, folder: str = "images") -> list[dict]:
    """Return frames as nerfstudio writes them."""
    rows = np.concatenate([known.c2w, np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(known.c2w), 1, 1))], axis=1)
    return [
        {"file_path": f"{folder}/{name}", "transform_matrix": row.tolist()}
        for name, row in zip(known.names, rows, strict=True)
    ]


def intrinsics_of(known: Known) -> dict[str, float]:
    (fl_x, fl_y), (cx, cy), (w, h) = known.focal, known.center, known.size
    return {"fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy, "w": w, "h": h}


def write_json(root: Path, content: object) -> Path:
    (root / "transforms.json").write_text(json.dumps(content))
    return root


def write_transforms(root: Path, known: Known, **top: object) -> Path:
    """Write nerfstudio's flavour: shared intrinsics at the top."""
    write_pictures(root / "images", known.names, known.size)
    return write_json(root, intrinsics_of(known) | {"frames": frames_of(known)} | top)


def write_instant_ngp(root: Path, known: Known) -> Path:
    """Write instant-ngp's flavour: angles, backslashes, no endings."""
    write_pictures(root / "images", known.names, known.size)
    (fl_x, fl_y), (w, h) = known.focal, known.size
    frames = frames_of(known)
    for frame in frames:
        frame["file_path"] = ".\\" + frame["file_path"].removesuffix(".png").replace("/", "\\")
    angles = {"camera_angle_x": 2 * np.arctan(w / 2 / fl_x), "camera_angle_y": 2 * np.arctan(h / 2 / fl_y)}
    return write_json(root, angles | {"aabb_scale": 4, "frames": frames})


def read(kind: str, root: Path, **settings: object) -> Scene:
    """Read a capture with a cache beside it."""
    return READERS[kind](root=str(root), cache_dir=str(root.parent / "cache"), **settings).read()


def user_rays(scene: Scene, name: str, at: list[tuple[float, float]]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return origins and unit directions in the user's frame of rays at places in a picture (shares of its size)."""
    view, cameras = scene.view_names.index(name), replace(scene.cameras, ndc=None)
    size = torch.stack([cameras.width[view], cameras.height[view]])
    x, y = (torch.tensor(at) * size).floor().long().unbind(dim=-1)
    rays = rays_through_pixels(cameras, PixelIndex(torch.full_like(x, view), x, y), scene.near, scene.far)
    rotation = scene.to_user[:3, :3].float()
    origins = rays.origins @ rotation.T + scene.to_user[:3, 3].float()
    return origins, rays.directions @ rotation.T / unit_of(scene.to_user)
