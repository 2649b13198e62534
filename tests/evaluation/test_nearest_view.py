"""What photographs give without a model: of a camera that one was taken with, that photograph; of a wall, the wall."""

from dataclasses import replace

import torch
from support.scenes import ball_scene

from nerf_lightning.evaluation import nearest_view as module
from nerf_lightning.evaluation.nearest_view import KINDS, NearestViews, baselines
from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, rays_through_pixels
from nerf_lightning.nerf.rendering.blending import photograph
from nerf_lightning.nerf.types.scene import PixelStore


def test_where_a_photograph_was_taken_from_it_is_shown_and_never_the_views_own():
    scene = ball_scene(num_views=8)
    c2w = scene.cameras.c2w.clone()
    view, train = scene.splits["test"][0], scene.splits["train"]
    c2w[view] = c2w[train[1]]
    scene = replace(scene, cameras=replace(scene.cameras, c2w=c2w))
    found = NearestViews(scene, "white", 2).pictures(view)
    shown = photograph(scene, train[1], "white")
    assert list(found) == list(KINDS)
    for kind in ("nearest", "nearest_on_plane", "blend", "blend_on_plane"):
        torch.testing.assert_close(found[kind], shown, atol=0.02, rtol=0.0)
    # Of a training view itself another one is shown.
    other = NearestViews(scene, "white", 1).pictures(train[1])["nearest"]
    assert float((other - shown).abs().max()) > 0.2


def wall_scene():
    """A wall of smooth colours through the origin, photographed from a few places in front of it."""
    eyes = torch.tensor([[0.0, 0.0, 4.0], [0.9, 0.3, 4.0], [-0.9, 0.6, 4.2], [0.3, -0.9, 3.9], [0.2, 0.2, 4.0]])
    c2w = torch.cat([torch.eye(3).expand(5, 3, 3), eyes[:, :, None]], dim=2)
    cameras, near, far = pinhole_cameras(c2w, 20.0, 16, 16), torch.full((5,), 2.0), torch.full((5,), 6.0)
    pictures = []
    for view in range(5):
        rays = rays_through_pixels(cameras, all_pixels(cameras, view), near, far)
        at = rays.origins - (rays.origins[..., 2:] / rays.directions[..., 2:]) * rays.directions
        color = torch.stack([0.5 + 0.2 * at[..., 0], 0.5 + 0.2 * at[..., 1], 0.5 + 0.1 * at.sum(dim=-1)], dim=-1)
        pictures.append(torch.cat([color.clamp(0, 1), torch.ones(16, 16, 1)], dim=-1))
    rgba = (torch.stack(pictures) * 255).round().to(torch.uint8).reshape(-1, 4)
    sizes = torch.full((5,), 16)
    return replace(
        ball_scene(num_views=5),
        cameras=cameras,
        near=near,
        far=far,
        pixels=PixelStore(rgba, torch.arange(5) * 256, sizes, sizes, has_transparency=False),
        splits={"train": (0, 1, 2, 3), "val": (4,), "test": (4,)},
    )


def test_a_wall_across_the_axis_is_seen_through_the_plane_where_cameras_look_there(monkeypatch):
    """Cameras that all face forward meet nowhere, so what they look at is said here: the wall."""
    scene = wall_scene()
    plain = module.photographs_of
    at_wall = torch.zeros(1, 3)
    monkeypatch.setattr(module, "photographs_of", lambda *given: replace(plain(*given), middle=at_wall))
    found, truth = NearestViews(scene, "white", 4).pictures(4), photograph(scene, 4, "white")
    inside = (slice(1, 15), slice(1, 15))
    for kind in ("nearest_on_plane", "blend_on_plane"):
        torch.testing.assert_close(found[kind][inside], truth[inside], atol=0.003, rtol=0.0)
    assert float((found["nearest"] - truth)[inside].abs().max()) > 0.01


def test_the_means_are_those_of_the_pictures():
    scene = ball_scene(num_views=8)
    views = list(scene.splits["test"])
    found = baselines(scene, views, "white", 2)
    pictures = [NearestViews(scene, "white", 2).pictures(view)["blend"] for view in views]
    errors = [
        (picture - photograph(scene, view, "white")).square().mean()
        for picture, view in zip(pictures, views, strict=True)
    ]
    assert abs(found["blend"] - float(sum(-10 * error.log10() for error in errors) / len(errors))) < 1e-4
    assert found["photographs"] == 2
