"""A sound capture of the noisy corner as a scene, and what its checks say."""

from collections.abc import Collection
from dataclasses import replace
from functools import cache

import torch
from support.corner import FOCAL, HEIGHT, WIDTH, corner_poses, photograph

from nerf_lightning.data.pixels.store import layout
from nerf_lightning.doctor import poses
from nerf_lightning.doctor.check import Analysis, Check
from nerf_lightning.doctor.epipolar import agreeing
from nerf_lightning.doctor.examine import CHECKS, analyze
from nerf_lightning.nerf.geometry.cameras import pinhole_cameras
from nerf_lightning.nerf.types.scene import PixelStore, Scene

VIEWS = 12


@cache
def corner_scene() -> Scene:
    """Twelve photographs on an arc, all of them good; every fourth is held out."""
    c2w = corner_poses(VIEWS)
    grey = torch.stack([torch.from_numpy(photograph(pose)) for pose in c2w])
    rgba = grey[..., None].repeat(1, 1, 1, 4)
    rgba[..., 3] = 255
    # In the middle between the extremes, so that brightness can go either way.
    rgba[..., :3] = 40 + (rgba[..., :3].float() * 0.6).to(torch.uint8)
    held = tuple(range(0, VIEWS, 4))
    return Scene(
        name="corner",
        cameras=pinhole_cameras(torch.from_numpy(c2w).float(), FOCAL, WIDTH, HEIGHT),
        pixels=PixelStore(rgba.reshape(-1, 4), *layout([(WIDTH, HEIGHT)] * VIEWS), has_transparency=False),
        near=torch.full((VIEWS,), 0.5),
        far=torch.full((VIEWS,), 12.0),
        aabb=torch.tensor([[-0.5] * 3, [0.5] * 3]),
        splits={"train": tuple(v for v in range(VIEWS) if v not in held), "val": held, "test": held},
        view_names=tuple(f"view {number}.png" for number in range(VIEWS)),
        background="black",
        to_user=torch.eye(4, dtype=torch.float64),
        protocol={},
        truth=None,
        space="contracted",
    )


@cache
def corner_analysis() -> Analysis:
    """What the checks see of the sound capture."""
    return analyze(corner_scene())


def with_poses(c2w: torch.Tensor) -> Analysis:
    """The same photographs, so the same matches, with other poses."""
    sound = corner_analysis()
    cameras = replace(sound.scene.cameras, c2w=c2w)
    return replace(sound, scene=replace(sound.scene, cameras=cameras), agrees=agreeing(sound.matches, c2w))


def with_scene(**changes) -> Analysis:
    """The same photographs and cameras, with other fields of the scene."""
    sound = corner_analysis()
    return replace(sound, scene=replace(sound.scene, **changes))


def with_pictures(change) -> Analysis:
    """Photographs after `change` (views, height, width, 4) -> the same."""
    scene = corner_scene()
    rgba = change(scene.pixels.rgba.view(VIEWS, HEIGHT, WIDTH, 4).clone())
    transparent = bool((rgba[..., 3] < 255).any())
    pixels = replace(scene.pixels, rgba=rgba.reshape(-1, 4), has_transparency=transparent)
    return analyze(replace(scene, pixels=pixels))


def outcome(analysis: Analysis, but: Collection[str] = ()) -> dict[str, Check]:
    """Every check by its name."""
    return {name: replace(check(analysis), name=name) for name, check in CHECKS.items() if name not in but}


def but_poses(analysis: Analysis) -> dict[str, Check]:
    """All but those that try many readings of the poses, which take longer."""
    return outcome(analysis, poses.CHECKS)
