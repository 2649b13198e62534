"""The contract of a camera path: a frame of reference in, cameras in temporal order out.

The user's input and output (positions, distances, directions) is in the frame and the units of the capture's own files;
`PathFrame.to_user` maps the working frame to it.

The defaults of size and frames per second: `conf/camera_path_defaults.yaml`; the numbers of each path: `conf/path/`.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.files.budgets import limits
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import focal_from_fov, pinhole_cameras
from nerf_lightning.nerf.geometry.poses import is_rigid
from nerf_lightning.nerf.geometry.world_frame import points_from_user, unit_of
from nerf_lightning.nerf.matmul_precision import disable_autocast
from nerf_lightning.nerf.types.scene import Cameras

NDC_FOCUS = 5.0  # Distance of the point that a camera in front of a scene looks at, in units of the near plane's.
LARGEST = 1e15  # Larger numbers overflow when they are squared.

Content = Callable[[], Float[Tensor, "points 3"]]


@dataclass(frozen=True)
class PathFrame:
    """What a path moves around, and its kind of camera."""

    center: Float[Tensor, "3"]
    """The point to look at, in scene coordinates."""
    up: Float[Tensor, "3"]
    """Direction of the picture's top; any nonzero length."""
    radius: float
    """Distance of the photographs from the center, in scene units."""
    focal: float
    """Focal length in pixels, for a picture of `width` by `height`."""
    width: int
    height: int
    poses: Float[Tensor, "views 3 4"]
    """Poses of the photographs, camera to world."""
    to_user: Float[Tensor, "4 4"] = field(default_factory=lambda: torch.eye(4))
    """Similarity from scene coordinates to the capture's own frame."""
    view_names: tuple[str, ...] = ()
    """Names of the photographs, in the order of `poses`."""
    forward_facing: bool = False
    """Whether all photographs look the same way, into normalized device coordinates."""
    bounded: bool = False
    """Whether nothing is behind the content, so that it may be viewed from any distance."""
    content: Content = lambda: torch.zeros(0, 3)
    """Returns points of what the photographs show in their middle; none if no model is known."""

    @property
    def unit(self) -> float:
        """How many of the user's units make one of the scene's."""
        return unit_of(self.to_user)

    def point(
        self, name: str, value: Sequence[int | float] | None, otherwise: Float[Tensor, "3"] | None = None
    ) -> Float[Tensor, "3"]:
        """Return a point that the user gave as setting `name`, in scene coordinates; None: another (the center)."""
        if value is None:
            return self.center if otherwise is None else otherwise
        check_setting(name, value, is_point(value), "three finite numbers, [x, y, z], in the capture's own frame")
        point = torch.tensor([[float(number) for number in value]], dtype=torch.float64)
        return points_from_user(point, self.to_user.double())[0].to(self.center)

    @disable_autocast
    def direction(self, vector: Sequence[float]) -> Float[Tensor, "3"]:
        """Return a direction that the user gave as a unit vector of the scene."""
        user = torch.tensor([float(number) for number in vector], dtype=torch.float64)
        return normalize(self.to_user[:3, :3].double().mT @ user, dim=0).to(self.center)

    def size(self, width: int | None, height: int | None) -> tuple[int, int, float]:
        """Return a picture's width, height, and the factor on its focal length in pixels.

        A side that is None follows the other; if both are, they are the frame's own.
        """
        if width is None and height is not None:
            scale = height / self.height
            return max(1, round(self.width * scale)), height, scale
        width = self.width if width is None else width
        scale = width / self.width
        return width, (max(1, round(self.height * scale)) if height is None else height), scale


def is_point(value: object) -> bool:
    """Return whether a value is three finite numbers.

    >>> is_point([0, 1.5, -2]), is_point([0, 1]), is_point("top")
    (True, False, False)
    """
    return isinstance(value, (list, tuple)) and len(value) == 3 and all(map(is_number, value))


def is_number(value: object) -> bool:
    """Return whether a value is a number that a path can have: finite, and not astronomical."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < LARGEST


def check_setting(name: str, value: object, good: bool, rule: str) -> None:
    """Refuse an invalid setting of a path."""
    if not good:
        raise InputError(f"path.{name} is {value}, but must be {rule}")


def check_turns(turns: float, start: float = 0.0) -> None:
    """Refuse an invalid number of circles, or an invalid angle in degrees at which they begin."""
    check_setting("turns", turns, math.isfinite(turns) and turns != 0, "a finite number of circles, not 0")
    check_setting("start", start, math.isfinite(start), "a finite angle in degrees")


@disable_autocast
def level_axes(up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return the unit vectors up, of azimuth 0, and of azimuth 90 degrees.

    Azimuth 0 is the x axis projected to the horizon, or the y axis if x is nearly up.
    """
    up = normalize(up, dim=0)
    axis = torch.zeros_like(up)
    axis[0 if abs(float(up[0])) < 0.9 else 1] = 1.0
    east = normalize(axis - (axis @ up) * up, dim=0)
    return up, east, torch.linalg.cross(up, east)


@dataclass
class CameraPath(ABC):
    """A path of virtual cameras for a video; subclasses add their own settings.

    Args:
        num_frames: number of cameras.
        width: image width in pixels; None: from the height, or as the photographs.
        height: image height in pixels; None: from the width, or as the photographs.
        fov: horizontal field of view in degrees; None: as the photographs.
        fps: frames per second.
    """

    num_frames: int = 120
    _: KW_ONLY
    width: int | None = None
    height: int | None = None
    fov: float | None = None
    fps: int = 30

    def __post_init__(self) -> None:
        width, height, fov = self.width, self.height, self.fov
        most = limits().film_frames
        check_setting("num_frames", self.num_frames, self.num_frames >= 1, "at least 1")
        limit = f"at most {most:,} (more with budgets.film_frames)"
        check_setting("num_frames", self.num_frames, self.num_frames <= most, limit)
        check_setting("width", width, width is None or width >= 1, "at least 1 pixel, or null")
        check_setting("height", height, height is None or height >= 1, "at least 1 pixel, or null")
        check_setting("fov", fov, fov is None or 0 < fov < 180, "between 0 and 180 degrees, both excluded, or null")
        check_setting("fps", self.fps, self.fps >= 1, "at least 1")

    @abstractmethod
    def cameras(self, around: PathFrame) -> Cameras:
        """Return one camera per frame, all of one size, in temporal order."""

    def pinholes(self, c2w: Float[Tensor, "frames 3 4"], around: PathFrame) -> Cameras:
        """Return cameras at these poses. A picture of another size keeps the horizontal field of view."""
        lost = (~is_rigid(c2w)).nonzero().flatten().tolist()
        if lost:
            raise InputError(
                f"The camera of frame {lost[0]} of the path looks along its own up axis, or at its own position "
                f"({len(lost)} of {len(c2w)} frames do), so its picture has no top. Move it, or give another up."
            )
        width, height, scale = around.size(self.width, self.height)
        focal = around.focal * scale if self.fov is None else focal_from_fov(width, math.radians(self.fov))
        return pinhole_cameras(c2w, focal, width, height)


def frame_of(
    cameras: Cameras,
    aabb: Float[Tensor, "2 3"],
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    to_user: Float[Tensor, "4 4"] | None = None,
    view_names: tuple[str, ...] = (),
) -> PathFrame:
    """Return the frame of a capture: the middle of its box, seen from the mean distance of its cameras.

    Forward-facing captures have no middle: theirs is in front of the mean camera, a few times as far as the near plane,
    and up is the mean camera's.

    Focal length and size are those of the first camera (of a panorama, 90 degrees across); its lens and principal point
    are ignored, since paths are rendered through a centered pinhole. The default `up` is the world's z axis.
    """
    center = aabb.mean(dim=0).to(cameras.c2w)
    if cameras.ndc is not None:
        center, up = torch.tensor([0.0, 0.0, -NDC_FOCUS]).to(cameras.c2w), (0.0, 1.0, 0.0)
    # For panoramas a film shows a natural field of view: 90 degrees across.
    panoramas = cameras.lens_model == "equirectangular"
    return PathFrame(
        center=center,
        up=torch.tensor(up).to(cameras.c2w),
        radius=float((cameras.c2w[:, :, 3] - center).norm(dim=-1).mean()),
        focal=0.5 * int(cameras.width[0]) if panoramas else float(cameras.focal[0, 0]),
        width=int(cameras.width[0]),
        height=int(cameras.height[0]),
        poses=cameras.c2w,
        to_user=torch.eye(4) if to_user is None else to_user,
        view_names=view_names,
        forward_facing=cameras.ndc is not None,
    )
