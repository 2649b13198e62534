"""Grids: density at the right place, in the user's units, and colors of occupied cells."""

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.known_fields import INSIDE, ball, solid
from support.peak_bytes import peak_bytes
from support.scenes import ball_scene

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.extensions.geometry_exports.density_grid import CHUNK
from nerf_lightning.extensions.geometry_exports.surface import PAIRS, looks_from_facing, looks_from_nearest
from nerf_lightning.extensions.geometry_exports.volume import BYTES_PER_POINT, VolumeExport
from nerf_lightning.nerf.geometry.world_frame import similarity

CENTER = (0.3, 0.0, -0.2)


def record(**changes):
    return replace(scene_record(ball_scene(num_views=4, size=8)), **changes)


def test_the_grid_lies_where_the_json_says_in_the_users_units(tmp_path):
    to_user = similarity(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([5.0, 6.0, 7.0]), 4.0)
    arrays, about = VolumeExport(40).export(solid(ball(0.5, CENTER)), record(to_user=to_user), tmp_path, 4096)
    said = json.loads(about.read_text())
    with np.load(arrays, allow_pickle=False) as content:
        density, rgb = content["density"], content["rgb"]
    assert density.shape == tuple(said["shape"]) == rgb.shape[:3] == (41, 41, 41)
    index = np.stack(np.meshgrid(*map(np.arange, density.shape), indexing="ij"), axis=-1)
    matrix = np.array(said["index_to_user"])
    places = index @ matrix[:3, :3].T + matrix[:3, 3]
    distance = np.linalg.norm(places - [5 + 4 * 0.3, 6, 7 + 4 * 0.2], axis=-1) - 4 * 0.5
    np.testing.assert_allclose(density[distance < -0.6], INSIDE / 4, rtol=0.01)
    assert density[distance > 1.0].max() < 1e-3
    assert said["spacing"] == pytest.approx(4 * 2 / 40)
    red = places[..., 0] > 5.01
    assert (rgb[(distance < -0.6) & red] == [255, 0, 0]).all()
    assert (rgb[distance > 1.0] == 0).all()


def test_a_grid_takes_no_more_memory_than_is_asked_for(tmp_path, monkeypatch):
    points = 97**3
    # It writes 16 MB at a time, more than all here.
    monkeypatch.setattr(np, "savez_compressed", lambda part, **arrays: part.write_bytes(b""))
    tracemalloc.start()
    VolumeExport(96).export(solid(ball(), inside=0.0), record(), tmp_path, CHUNK)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 0.8 * BYTES_PER_POINT * points < most < BYTES_PER_POINT * points + 4 * CHUNK


@pytest.mark.parametrize("look", [looks_from_nearest, lambda at, eyes: looks_from_facing(at, at, eyes)])
def test_many_cameras_are_asked_a_part_of_the_points_at_a_time(look):
    points, eyes = torch.rand(20_000, 3), torch.rand(500, 3) + 2.0
    parts = torch.cat([look(part, eyes) for part in points.split(37)], dim=1)
    torch.testing.assert_close(look(points, eyes), parts)
    assert peak_bytes(lambda: look(points, eyes), torch.device("cpu")) < 40 * PAIRS + 100 * len(points)


def test_points_are_looked_at_from_the_nearest_cameras_and_from_those_they_face():
    eyes = torch.tensor([[1.0, 0, 0], [0, 2, 0], [0, 0, 3], [0, 0, -9]])
    at, normal = torch.zeros(1, 3), torch.tensor([[0.0, 0.6, -0.8]])
    assert looks_from_nearest(at, eyes)[:, 0].tolist() == [[-1, 0, 0], [0, -1, 0], [0, 0, -1]]
    assert looks_from_facing(at, normal, eyes)[:, 0].tolist() == [[0, 0, 1], [0, -1, 0], [-1, 0, 0]]
    assert looks_from_nearest(at, eyes[:2]).shape == (2, 1, 3)
