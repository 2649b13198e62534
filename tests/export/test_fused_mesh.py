"""what.surface=tsdf: what the views see comes back where it is, open where none looks; what cannot be is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from support.known_fields import INSIDE, SOFT, ball, solid
from support.scenes import ball_scene

from nerf_lightning.checkpoints.reading import scene_record
from nerf_lightning.export.fused_mesh import depth_rays
from nerf_lightning.export.mesh import MeshExport
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import all_pixels

RADIUS, TILE = 0.8, 1 << 15


def record(**changes):
    return replace(scene_record(ball_scene(num_views=8, size=24)), **changes)


def exported(folder, model, scene, **settings):
    (path,) = MeshExport(**{"resolution": 40, "surface": "tsdf"} | settings).export(model, scene, folder, TILE)
    return trimesh.load(path, process=False)


def test_a_ball_comes_back_to_within_a_cell_and_only_what_is_seen_of_it(tmp_path):
    scene = record()
    mesh = exported(tmp_path, solid(ball()), scene)
    radius, cell = np.linalg.norm(mesh.vertices, axis=1), 2.0 / 40
    # A ray at the middle has half of its light behind it where INSIDE * SOFT * log(1 + exp(-d / SOFT)) = log 2.
    expected = RADIUS - SOFT * np.log(np.expm1(np.log(2) / (INSIDE * SOFT)))
    assert np.abs(radius - expected).mean() < 0.25 * cell
    assert np.quantile(np.abs(radius - expected), 0.95) < cell
    assert np.abs(radius - expected).max() < 2 * cell  # at the rim, which all views graze
    assert not mesh.is_watertight
    outward = (np.asarray(mesh.vertex_normals) * mesh.vertices).sum(axis=1) / radius
    assert outward.min() > 0.0
    assert outward.mean() > 0.95
    # Four views from a half circle: what is turned away from all of them is not there.
    eyes = scene.cameras.c2w[list(scene.splits["train"]), :, 3].numpy()
    places = mesh.vertices / radius[:, None]
    assert (places @ (eyes / np.linalg.norm(eyes, axis=1, keepdims=True)).T).max(axis=1).min() > -0.1


def test_the_inside_of_things_is_no_part_of_it(tmp_path):
    hollow = solid(lambda points: torch.maximum(ball(0.8)(points), -ball(0.4)(points)))
    assert np.linalg.norm(exported(tmp_path, hollow, record()).vertices, axis=1).min() > 0.7


def test_a_panorama_is_seen_through_the_faces_of_a_cube():
    scene = record()
    cameras = replace(scene.cameras, lens_model="equirectangular")
    rays_of = depth_rays(replace(scene, cameras=cameras), 16)
    number = len(scene.splits["train"])
    assert rays_of.cameras.lens_model == "pinhole"
    assert rays_of.cameras.c2w.shape == (6 * number, 3, 4)
    turned = rays_of.cameras.c2w[:6, :, :3]
    np.testing.assert_allclose(torch.linalg.det(turned), 1.0, atol=1e-5)
    directions = torch.cat([rays_of(all_pixels(rays_of.cameras, view)).directions.flatten(0, 1) for view in range(6)])
    everywhere = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    assert float((everywhere @ directions.mT).amax(dim=1).min()) > 0.99


def test_a_lens_is_left_out_of_rendered_depth():
    scene = scene_record(ball_scene(num_views=4, size=24, lens=(0.1, 0, 0, 0, 0, 0), lens_model="radial_tangential"))
    cameras = depth_rays(scene, 48).cameras
    assert cameras.lens_model == "pinhole"
    assert not cameras.lens.any()
    assert cameras.width.tolist() == [48, 48]
    assert cameras.focal[0, 0] == 2 * scene.cameras.focal[0, 0]


def test_what_no_view_sees_is_refused_with_the_cure(tmp_path):
    with pytest.raises(InputError, match=r"no training view of ball sees anything opaque in its box.*Train longer"):
        exported(tmp_path, solid(ball(), inside=0.01), record())
    elsewhere = record(aabb=torch.tensor([[5.0, 5.0, 5.0], [6.0, 6.0, 6.0]]))
    with pytest.raises(InputError, match=r"no training view of ball sees anything opaque in its box"):
        exported(tmp_path, solid(ball()), elsewhere)
    assert not list(tmp_path.iterdir())
