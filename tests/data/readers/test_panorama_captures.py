"""Panoramas as nerfstudio writes them: read, examined, exported and read again."""

import json

import numpy as np
import pytest
import torch
from PIL import Image
from support.panoramas import near_the_bricks, write_panoramas
from support.scenes import tiny_model
from support.steps import rays_of

from nerf_lightning.checkpoints.record import make_record, scene_record
from nerf_lightning.data.readers.colmap import ColmapReader
from nerf_lightning.data.readers.transforms import TransformsReader
from nerf_lightning.doctor.examine import examine
from nerf_lightning.export.cameras import CamerasExport
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import all_pixels
from nerf_lightning.nerf.geometry.world_frame import directions_to_user, points_to_user
from nerf_lightning.video.paths.photograph_path import PhotographPath
from nerf_lightning.video.shots import lay_path


def read(root, **settings):
    return TransformsReader(root=str(root), cache_dir=str(root.parent / "cache"), **settings).read()


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_panoramas(tmp_path_factory.mktemp("panoramas") / "capture")


@pytest.fixture(scope="module")
def scene(root):
    return read(root)


def in_user_frame(scene, rays):
    to_user = scene.to_user.double()
    return points_to_user(rays.origins.double(), to_user), directions_to_user(rays.directions.double(), to_user)


def test_rays_are_those_that_nerfstudio_makes_of_the_same_file(scene):
    assert scene.cameras.lens_model == "equirectangular"
    assert scene.space == "contracted"
    index = all_pixels(scene.cameras, 3)
    origins, directions = in_user_frame(scene, rays_of(scene)(index))
    pose = near_the_bricks(8)[3]
    # From its documentation: u to the right and v upwards in [-1, 1], half a turn either way.
    theta, phi = np.pi * ((index.x + 0.5).double() - 32) / 32, np.pi * (0.5 + ((index.y + 0.5).double() - 16) / 32)
    local = torch.stack([theta.sin() * phi.sin(), phi.cos(), -theta.cos() * phi.sin()], dim=-1)
    torch.testing.assert_close(directions, local @ pose[:, :3].mT, atol=1e-5, rtol=0)
    torch.testing.assert_close(origins, pose[:, 3].expand_as(origins), atol=1e-5, rtol=0)


def test_focal_lengths_may_be_left_out_and_pictures_may_be_shrunk(root, scene, tmp_path):
    content = json.loads((root / "transforms.json").read_text())
    for key in ("fl_x", "fl_y", "w", "h"):
        del content[key]
    (root / "bare.json").write_text(json.dumps(content))
    bare = read(root, file="bare.json")
    torch.testing.assert_close(bare.cameras.focal, scene.cameras.focal)
    torch.testing.assert_close(read(root, downscale=2).cameras.focal, 0.5 * scene.cameras.focal)


def test_the_doctor_examines_them_and_finds_nothing_wrong(scene):
    _, checks = examine(scene)
    assert not [check for check in checks if check.verdict == "wrong"]


def test_in_a_box_they_are_carved_and_ndc_is_refused(root):
    bounded = read(root, space="bounded")
    assert bool((bounded.near < bounded.far).all())
    with pytest.raises(InputError, match=r"scene\.space=ndc needs cameras that all look the same way"):
        read(root, space="ndc")


def assert_same_rays(ours, theirs):
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other, atol=1e-5, rtol=0)


def test_cameras_that_were_exported_give_the_same_rays(scene, tmp_path, caplog):
    CamerasExport(images="images").export(tiny_model(), scene_record(scene), tmp_path, 4096)
    assert "COLMAP" not in caplog.text
    for name in scene.view_names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (64, 32)).save(tmp_path / "images" / name)
    for kind in (read, lambda root: ColmapReader(str(root), cache_dir=str(root / "cache")).read()):
        back = kind(tmp_path)
        assert_same_rays(*(in_user_frame(each, rays_of(each)(all_pixels(each.cameras, 2))) for each in (scene, back)))


def test_films_of_them_show_what_a_person_would_look_at_and_checkpoints_keep_them(scene):
    cameras = lay_path(PhotographPath(3), scene)
    assert cameras.lens_model == "pinhole"
    assert float(cameras.focal[0, 0]) == pytest.approx(32.0)  # 90 degrees across 64 pixels
    assert make_record(scene, "", {})["scene"]["cameras"]["lens_model"] == "equirectangular"
