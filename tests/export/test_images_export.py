"""Depth, opacity and normals as pictures, in the user's units; and density where rays look for it alone."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from support.known_fields import ball, solid
from support.scenes import ball_scene, some_rays

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.export.images import ImagesExport
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.encoders.spherical_harmonics import SphericalHarmonicsEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.geometry.world_frame import similarity, upright_rotation
from nerf_lightning.nerf.models.masked_level import MaskedLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.types.rays import Points

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


def test_a_view_that_does_not_fit_into_memory_is_refused_before_it_is_rendered_and_so_is_none(tmp_path):
    """A checkpoint may say any size up to budgets.view_pixels."""
    scene = record_of_views()
    sizes = {"width": torch.full((4,), 1 << 40), "height": torch.ones(4, dtype=torch.int64)}
    scene = replace(scene, cameras=replace(scene.cameras, **sizes))
    with pytest.raises(InputError, match=r"The view \w+ has 1099511627776 x 1 pixels .* Views of up to [\d,]+ pixels"):
        ImagesExport().export(solid(ball()), scene, tmp_path / "out", TILE)
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match=r"what\.max_views=0"):
        ImagesExport(max_views=0)


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
