"""Grids: the density where it is, in the user's units, and colours where something is."""

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from support.known_fields import INSIDE, ball, solid
from support.scenes import ball_scene, some_rays

from nerf_lightning.checkpoints.reading import scene_record
from nerf_lightning.commands.train_job.memory_trial import peak_bytes
from nerf_lightning.export.density_grid import CHUNK
from nerf_lightning.export.images import ImagesExport
from nerf_lightning.export.surface import PAIRS, looks_from_facing, looks_from_nearest
from nerf_lightning.export.volume import BYTES_PER_POINT, VolumeExport
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.geometry.frames import similarity, upright_rotation
from nerf_lightning.nerf.models.masked_level import MaskedLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.types.points import Points

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


@pytest.mark.parametrize("kind", [RaggedLevel, MaskedLevel])
def test_what_rays_pass_by_has_no_density(kind):
    torch.manual_seed(0)

    encoder = HashGridEncoder(num_levels=2, log2_table_size=8, min_resolution=4, max_resolution=8)
    field = NGPField(encoder, SphericalHarmonicsEncoder(), density_bias=3.0)
    level = kind(OccupancySampler(resolution=8), field)
    model, points = RadianceModel({"fine": level}).eval(), some_rays(500).origins / 4
    with torch.no_grad():
        assert bool((model.density(points) > 0).all())
        level.sampler.grid.occupy(torch.zeros_like(level.sampler.grid.possible))
        assert not bool(model.density(points).any())
        half = torch.zeros_like(level.sampler.grid.possible)
        half[4:] = True
        level.sampler.grid.occupy(half)
        found = model.density(points)
        torch.testing.assert_close(found > 0, points[:, 0] >= 0)
        torch.testing.assert_close(found[found > 0], field.density(Points(points))[0][found > 0])


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


TILE, SIZE, UNIT = 1 << 15, 33, 50.0
TURN = upright_rotation(torch.tensor([1.0, 0.0, 0.0]))


def record_of_views(**changes):
    scene = scene_record(ball_scene(num_views=4, size=SIZE))
    return replace(scene, to_user=similarity(TURN, torch.tensor([5.0, 6.0, 7.0]), UNIT), **changes)


def exported_images(folder, **settings):
    scene = record_of_views(view_names=("../a.jpg", "b/1.2", "c.png", "d"))
    ImagesExport(**settings).export(solid(ball()), scene, folder, TILE)
    return scene, json.loads((folder / "images.json").read_text())


def test_depth_is_in_the_users_units_and_the_png_says_the_same(tmp_path):
    scene, said = exported_images(tmp_path, split="all")
    assert said["views"] == {"../a.jpg": "0000_.._a", "b/1.2": "0001_b_1.2", "c.png": "0002_c", "d": "0003_d"}
    for view, name in enumerate(said["views"].values()):
        depth = np.load(tmp_path / "depth" / f"{name}.npy")
        distance = float(scene.cameras.c2w[view, :, 3].norm())
        assert depth[SIZE // 2, SIZE // 2] == pytest.approx(UNIT * (distance - 0.8), abs=0.05 * UNIT)
        assert np.isnan(depth[0, 0])
        picture = np.array(Image.open(tmp_path / "depth" / f"{name}.png"))
        assert picture.dtype == np.uint16
        np.testing.assert_allclose(picture * said["depth_scale"], np.nan_to_num(depth), atol=said["depth_scale"])
        opacity = np.array(Image.open(tmp_path / "opacity" / f"{name}.png"))
        assert (opacity[SIZE // 2, SIZE // 2], opacity[0, 0]) == (255, 0)
        normal = np.array(Image.open(tmp_path / "normals" / f"{name}.png"))[SIZE // 2, SIZE // 2] / 127.5 - 1
        facing = TURN.numpy() @ (scene.cameras.c2w[view, :, 3] / distance).numpy()
        np.testing.assert_allclose(normal, facing, atol=0.05)
    assert picture.max() > 0.9 * 65535


def test_z_is_shorter_than_the_distance_beside_the_axis(tmp_path):
    exported_images(tmp_path / "ray", max_views=1)
    exported_images(tmp_path / "z", max_views=1, depth="z")
    (name,) = json.loads((tmp_path / "z" / "images.json").read_text())["views"].values()
    along, z = (np.load(tmp_path / kind / "depth" / f"{name}.npy") for kind in ("ray", "z"))
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    cosine = 1 / np.sqrt(1 + (x**2 + y**2) / (1.6 * SIZE) ** 2)
    np.testing.assert_allclose(z, along * cosine, rtol=1e-4)


def test_a_view_that_does_not_fit_into_memory_is_refused_before_it_is_rendered(tmp_path):
    """A checkpoint may say any size up to budgets.view_pixels."""
    scene = record_of_views()
    sizes = {"width": torch.full((4,), 1 << 40), "height": torch.ones(4, dtype=torch.int64)}
    scene = replace(scene, cameras=replace(scene.cameras, **sizes))
    with pytest.raises(InputError, match=r"The view \w+ has 1099511627776 x 1 pixels .* Views of up to [\d,]+ pixels"):
        ImagesExport().export(solid(ball()), scene, tmp_path / "out", TILE)
    assert not (tmp_path / "out").exists()
