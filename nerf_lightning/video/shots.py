"""What each frame of a film shows of each model: cameras in the model's frame, and where rays begin and end."""

import logging
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import (
    at_most,
    camera_coordinates,
    coarse_pixels,
    rays_through_pixels,
    seen_at,
)
from nerf_lightning.nerf.geometry.clipping import Clip, CropBox
from nerf_lightning.nerf.geometry.ndc import LEAST_FORWARD
from nerf_lightning.nerf.geometry.near_far_of_new_views import near_and_far_from
from nerf_lightning.nerf.geometry.panoramas import panorama_cameras
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.geometry.surfaces import normals_from_depth
from nerf_lightning.nerf.geometry.world_frame import poses_from_user, told_length, unit_of
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import Picture, picture_surface, render_picture
from nerf_lightning.nerf.types.scene import Background, Cameras, SceneRecord
from nerf_lightning.video.paths.base import CameraPath, Content, PathFrame, frame_of
from nerf_lightning.video.paths.sweep import MIDDLE
from nerf_lightning.video.settings import FilmSettings
from nerf_lightning.visualization.pictures import joint_range

# Number of frames that the range of the depth's colors is taken from, and the maximum length of their longer side.
PROBES, PROBE_PIXELS = 12, 64
MOST_POINTS = 1000  # Of the content
IN_MOST = 0.5  # Share of the views: what these show in their middle is the subject of the capture.

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Subject:
    """A model to film, and the scene it was learned from."""

    model: Model
    scene: SceneRecord
    background: Background
    label: str = ""


@dataclass(frozen=True)
class Shot:
    """All frames of one model."""

    subject: Subject
    cameras: Cameras
    seen_from: Cameras | None
    """Cameras whose directions determine the color, if the camera itself is held."""
    near: Float[Tensor, "frames"]
    far: Float[Tensor, "frames"]
    clip: Clip | None
    tile_points: int

    @property
    def unit(self) -> float:
        """How many meters, or user's units if their length is unknown, make one of the scene's."""
        return told_length(self.subject.scene)[0]

    @property
    def rays(self) -> RayGenerator:
        """The generator of the frames' rays."""
        return RayGenerator(self.cameras, self.near, self.far)

    def picture(self, frame: int) -> Picture:
        """Render one frame."""
        looked_up = None if self.seen_from is None else RayGenerator(self.seen_from, self.near, self.far)
        model, background = self.subject.model, self.subject.background
        return render_picture(model, self.rays, frame, background, self.tile_points, self.clip, looked_up)

    def normals(self, frame: int, picture: Picture) -> Float[Tensor, "height width 3"]:
        """Return the unit normals of the picture's surface, in the user's axes."""
        normals = normals_from_depth(self.surface(frame, picture))
        to_user = self.subject.scene.to_user
        return normals @ (to_user[:3, :3] / unit_of(to_user)).mT.to(normals)

    def z_depth(self, frame: int, picture: Picture) -> Float[Tensor, "height width"]:
        """Return the depth of the picture's surface from the camera, in meters or the user's units (`unit`).

        It is along the camera's axis; for a panorama, which has none, along the ray.
        """
        local = camera_coordinates(self.cameras, frame, self.surface(frame, picture))
        panorama = self.cameras.lens_model == "equirectangular"
        return self.unit * (local.norm(dim=-1) if panorama else -local[..., 2])

    def surface(self, frame: int, picture: Picture) -> Float[Tensor, "height width 3"]:
        """Return the points of the picture's surface."""
        return picture_surface(self.rays, frame, picture, self.clip)[1]

    def small(self) -> "Shot":
        """Return a few of the frames, at a small size."""
        chosen = evenly_spaced_subset(range(len(self.cameras.c2w)), PROBES)
        cameras = at_most(self.cameras[chosen], PROBE_PIXELS)
        return replace(self, cameras=cameras, seen_from=None, near=self.near[chosen], far=self.far[chosen])


def make_shots(
    subjects: list[Subject],
    path: CameraPath,
    tile_points: int,
    settings: FilmSettings | None = None,
) -> list[Shot]:
    """Return the shot of each model of a capture, on a path in the first one's frame; working frames may differ."""
    settings = settings or FilmSettings()
    first, near, crop = subjects[0].scene, settings.near, settings.crop
    cameras = lay_path(path, first, partial(content_of, subjects[0], tile_points))
    if settings.projection == "equirectangular":
        cameras = _panoramas(cameras, path, first)
    shots = []
    for subject in subjects:
        scene = replace(subject.scene, metres_per_unit=first.metres_per_unit)
        moved = _in_frame_of(cameras, first, scene)
        held = replace(moved, c2w=moved.c2w[:1].expand_as(moved.c2w)) if settings.hold_camera else moved
        clip = None
        if near is not None or crop is not None:
            box = None if crop is None else CropBox.from_user(*crop, scene.to_user)
            clip = Clip(None if near is None else near / unit_of(scene.to_user), box)
        _check_outside(held, clip)
        shot = shot_of(replace(subject, scene=scene), held, tile_points)
        _check_near(scene, clip, shot.far)
        shots.append(replace(shot, seen_from=moved if settings.hold_camera else None, clip=clip))
    return shots


def shot_of(subject: Subject, cameras: Cameras, tile_points: int) -> Shot:
    """Return the shot of a model by cameras in its frame."""
    near, far = near_and_far_from(cameras.c2w[:, :, 3], subject.scene)
    return Shot(subject, _bent(cameras, subject.scene), None, near, far, clip=None, tile_points=tile_points)


def lay_path(path: CameraPath, scene: SceneRecord, content: Content = PathFrame.content) -> Cameras:
    """Return the cameras of a path around a scene, or say why the path does not fit."""
    return path.cameras(frame_around(scene, content))


def frame_around(scene: SceneRecord, content: Content = PathFrame.content) -> PathFrame:
    """Return the frame of reference of paths around a scene."""
    frame = frame_of(scene.cameras, scene.aabb, to_user=scene.to_user, view_names=scene.view_names)
    return replace(frame, bounded=scene.space == "bounded", content=content)


@torch.no_grad()
def content_of(subject: Subject, tile_points: int) -> Float[Tensor, "points 3"]:
    """Return points that a few small training views show, if they are in the middle of most of these views."""
    shot = shot_of(subject, subject.scene.cameras[list(subject.scene.splits["train"])], tile_points).small()
    views, points = range(len(shot.cameras.c2w)), []
    for view in views:
        picture = shot.picture(view)
        surface = shot.surface(view, picture)
        points.append(surface[(picture.opacity > 0.5) & surface.isfinite().all(dim=-1)])
    every = torch.cat(points)
    share = torch.stack([_in_middle(shot.cameras, view, every) for view in views]).float().mean(dim=0)
    content = every[share >= IN_MOST]
    return content[:: 1 + len(content) // MOST_POINTS]


def _in_middle(cameras: Cameras, view: int, points: Float[Tensor, "points 3"]) -> Bool[Tensor, "points"]:
    inside, x, y = seen_at(cameras, view, points)
    across, down = ((2 * at + 1) / size[view] - 1 for at, size in ((x, cameras.width), (y, cameras.height)))
    return inside & (torch.maximum(across.abs(), down.abs()) <= MIDDLE)


def depth_range(shots: list[Shot]) -> tuple[float, float]:
    """Return near and far of what is seen on the whole path, in the shots' units, from a few small frames."""
    seen = ((shot.unit, shot.picture(frame)) for shot in map(Shot.small, shots) for frame in range(len(shot.near)))
    return joint_range((unit * picture.depth, picture.opacity) for unit, picture in seen)


def in_front_of_near_plane(cameras: Cameras) -> Bool[Tensor, "views"]:
    """Return which cameras normalized device coordinates can render: before the plane z = -1, and looking along -z."""
    zeros = torch.zeros(len(cameras.c2w))
    rays = rays_through_pixels(cameras, coarse_pixels(cameras), zeros, zeros)
    return (cameras.c2w[:, 2, 3] > -1.0) & (rays.directions[..., 2] < -LEAST_FORWARD).all(dim=-1)


def _panoramas(cameras: Cameras, path: CameraPath, scene: SceneRecord) -> Cameras:
    """Return panoramic cameras at the same places, with pictures twice as wide as high unless the user sets a size."""
    if scene.cameras.ndc is not None:
        raise InputError(
            f"projection=equirectangular looks in all directions, but {scene.name} was trained in normalized device "
            "coordinates, which contain only what is in front of its cameras. Train with scene.space=contracted."
        )
    if path.fov is not None:
        raise InputError(f"path.fov={path.fov:g} with projection=equirectangular: panoramas show all directions.")
    width, height = int(cameras.width[0]), int(cameras.height[0])
    if path.height is None:
        height = max(1, round(width / 2))
    elif path.width is None:
        width = 2 * height
    return panorama_cameras(cameras.c2w, width, height)


def _in_frame_of(cameras: Cameras, first: SceneRecord, scene: SceneRecord) -> Cameras:
    """Return cameras of the first scene's working frame in another's."""
    if torch.equal(first.to_user, scene.to_user):
        return cameras
    apart = torch.linalg.inv(first.to_user.double()) @ scene.to_user.double()
    return replace(cameras, c2w=poses_from_user(cameras.c2w.double(), apart).float())


def _bent(cameras: Cameras, scene: SceneRecord) -> Cameras:
    """Return the cameras, with rays in normalized device coordinates if the scene was learned in these."""
    if scene.cameras.ndc is None:
        return cameras
    count = len(cameras.c2w)
    if lost := int((~in_front_of_near_plane(cameras)).sum()):
        log.warning(
            f"{lost} of {count} cameras of the path look aside or are inside the content, where the forward-facing "
            f"capture {scene.name} shows nothing. Use path=spiral."
        )
    return replace(cameras, ndc=scene.cameras.ndc[:1].expand(count, 2))


def _check_outside(cameras: Cameras, clip: Clip | None) -> None:
    if clip is None or clip.box is None:
        return
    inside = clip.box.holds(cameras.c2w[:, :, 3]).nonzero().flatten().tolist()
    if inside:
        raise InputError(
            f"crop: the camera of frame {inside[0]} is in the box ({len(inside)} of {len(cameras.c2w)} frames are). "
            "Make the box smaller, or move the path away (for instance path=orbit path.radius=...)."
        )


def _check_near(scene: SceneRecord, clip: Clip | None, far_end: Float[Tensor, "frames"]) -> None:
    if clip is None or clip.near is None or scene.cameras.ndc is not None:
        return
    far = float(far_end.max())
    if clip.near >= far:
        unit = unit_of(scene.to_user)
        raise InputError(
            f"near={unit * clip.near:g} leaves nothing to see, because rays end at {unit * far:g}. Give a smaller one."
        )
