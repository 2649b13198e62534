"""Rays of a picture are made a tile at a time, which changes nothing of it, and takes no more memory."""

from dataclasses import replace

import pytest
import torch
from support.peak_bytes import peak_bytes
from support.scenes import LENSES, ball_scene, tiny_model

from nerf_lightning.evaluation.metrics import image_metrics
from nerf_lightning.nerf import row_chunks
from nerf_lightning.nerf.geometry.cameras import resized
from nerf_lightning.nerf.geometry.clipping import Clip
from nerf_lightning.nerf.geometry.panoramas import panorama_cameras
from nerf_lightning.nerf.geometry.surfaces import normals_from_depth
from nerf_lightning.nerf.models import render_image
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import render_picture
from nerf_lightning.nerf.part import fit_parts
from nerf_lightning.nerf.types.renderings import Rendering

TILE = 300
WIDTH, HEIGHT, LARGE_TILE = 500, 250, 4096
SCENE = ball_scene(size=19)
FORWARD = replace(SCENE.cameras, c2w=torch.eye(4)[:3].expand(len(SCENE.near), 3, 4), ndc=torch.full((6, 2), 1.6))
CAMERAS = {
    "pinhole": SCENE.cameras,
    "panorama": panorama_cameras(SCENE.cameras.c2w, 30, 15),
    "ndc": FORWARD,
    **{f"{kind} {lens[0]}": ball_scene(lens=lens, lens_model=kind, size=19).cameras for kind, lens in LENSES},
}


@pytest.mark.parametrize(
    ("name", "per_side", "space"),
    [(name, 1, "bounded") for name in CAMERAS] + [("pinhole", 3, "bounded"), ("fisheye 0.1", 2, "contracted")],
)
def test_a_picture_does_not_depend_on_its_tiles(name, per_side, space):
    model, generator = tiny_model(density_bias=0.5).eval(), RayGenerator(CAMERAS[name], SCENE.near, SCENE.far)
    fit_parts(model, replace(SCENE, space=space))
    model.subpixels._now = per_side
    whole, tiled = (render_picture(model, generator, 1, "white", points) for points in (1 << 20, TILE))
    for found, expected in zip(tiled.tensors(), whole.tensors(), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


class Fog(RadianceModel):
    """Sees the same everywhere, and takes no memory for it."""

    first_picture = 0

    def __init__(self):
        super().__init__({})
        self.parameter = torch.nn.Parameter(torch.zeros(()))

    def points_per_ray(self, training):
        return 1.0

    def forward(self, rays, background, random):
        seen = Rendering(rays.directions, rays.directions, rays.near, rays.near)
        return [seen, seen]


def large_view():
    cameras = replace(SCENE.cameras, lens=torch.full((6, 6), 0.01), lens_model="radial_tangential")
    side = torch.ones(6, dtype=torch.int64)
    return RayGenerator(resized(cameras, WIDTH * side, HEIGHT * side), SCENE.near, SCENE.far)


@pytest.mark.parametrize(("clip", "per_side"), [(Clip(near=2.5), 1), (None, 2)], ids=["clipped", "whole"])
def test_no_more_rays_than_a_tile_has_are_made_at_once(clip, per_side, monkeypatch):
    monkeypatch.setattr(render_image, "threads_on", lambda device: 1)
    model, rays_of, made = Fog(), large_view(), []
    model.subpixels._now = per_side
    forward = RayGenerator.forward
    monkeypatch.setattr(RayGenerator, "forward", lambda self, *of: made.append(of[0].x.numel()) or forward(self, *of))
    held = peak_bytes(lambda: render_picture(model, rays_of, 1, "white", LARGE_TILE, clip), torch.device("cpu"))
    assert 0 < max(made) <= LARGE_TILE
    finished = 4 * (3 + 1 + 1 + 3) * WIDTH * HEIGHT
    assert finished < held < finished + 1000 * LARGE_TILE


def test_metrics_are_those_of_the_whole_picture(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    render, truth = torch.rand(2, 50, 40, 3, generator=generator)
    kept = torch.rand(50, 40, generator=generator) > 0.3
    for mask in (None, kept):
        whole = image_metrics(render, truth, mask)
        with monkeypatch.context() as patch:
            patch.setattr(row_chunks, "CHUNK_PIXELS", 7 * 40)
            assert image_metrics(render, truth, mask) == pytest.approx(whole, rel=1e-6)
    normals = normals_from_depth(render)
    monkeypatch.setattr(row_chunks, "CHUNK_PIXELS", 3 * 40)
    assert torch.equal(normals_from_depth(render), normals)
