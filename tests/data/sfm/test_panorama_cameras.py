"""Cameras of panoramas: which pictures are some, and where those of a room stood."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from support.alignment import FLIP, colmap_poses, pose_errors, umeyama
from support.textured_room import SIZE, directions, to_walls, write_room

from nerf_lightning.data.sfm.find_poses import from_photographs
from nerf_lightning.data.sfm.panoramas import lens_of, of_one_kind
from nerf_lightning.data.sfm.photograph_folder import FoundPhotograph, find_photographs
from nerf_lightning.data.sfm.reader import PhotosReader
from nerf_lightning.data.sfm.settings import SfmSettings
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.nerf.geometry.panoramas import panorama_cameras
from nerf_lightning.nerf.geometry.world_frame import unit_of

HEIGHT = 192
WHOLE, NEARLY, PART, PLAIN = (512, 256), (512, 254), (512, 128), (512, 384)


def photographs(*kinds):
    """Return photographs of given sizes (width, height), which say that they are panoramas where a third value does."""
    return [
        FoundPhotograph(Path(f"{number}.jpg"), kind[0], kind[1], True, len(kind) > 2, ())
        for number, kind in enumerate(kinds)
    ]


def taken(panoramas, *kinds):
    """Return the numbers of those that are taken, and whether as panoramas."""
    found = of_one_kind(photographs(*kinds), panoramas, "images=DIR")
    (kind,) = {photograph.is_panorama for photograph in found}
    return [int(photograph.path.stem) for photograph in found], kind


@pytest.mark.parametrize(
    ("panoramas", "kinds", "expected"),
    [
        ("auto", [WHOLE] * 3, ([0, 1, 2], True)),
        ("auto", [*[WHOLE] * 3, NEARLY], ([0, 1, 2, 3], False)),
        ("auto", [(*NEARLY, "said")] * 3, ([0, 1, 2], True)),
        ("auto", [(*WHOLE, "said"), WHOLE, WHOLE, PLAIN], ([0, 1, 2], True)),
        ("auto", [(*WHOLE, "said"), PLAIN, (*PART, "said"), PLAIN, PLAIN], ([1, 3, 4], False)),
        ("auto", [PLAIN] * 3, ([0, 1, 2], False)),
        (True, [NEARLY, PLAIN, WHOLE, (*PART, "said"), WHOLE, PLAIN, PLAIN], ([0, 2, 4], True)),
        (False, [(*WHOLE, "said"), WHOLE, PLAIN], ([0, 1, 2], False)),
    ],
)
def test_panoramas_and_others_are_told_apart(panoramas, kinds, expected):
    assert taken(panoramas, *kinds) == expected


def test_what_was_decided_is_said_with_the_setting_that_changes_it(caplog):
    caplog.set_level("INFO")
    taken("auto", *[WHOLE] * 4)
    assert "images=DIR: all 4 pictures are exactly twice as wide as high, so they are read as panoramas" in caplog.text
    assert "panoramas=false" in caplog.text
    taken("auto", PLAIN, PLAIN, PLAIN, *[(*WHOLE, "said")] * 3)
    assert "3 of 6 pictures are left out, since they are panoramas: 3.jpg, 4.jpg, 5.jpg." in caplog.text
    assert "panoramas=true" in caplog.text
    taken("auto", PLAIN, *[(*WHOLE, "said")] * 3)
    assert "1 of 4 pictures are left out, since they are not full panoramas" in caplog.text


def test_too_few_of_one_kind_are_refused():
    with pytest.raises(InputError, match=r"images=DIR holds 2 full panoramas, 1 partial ones and 1 "):
        taken("auto", (*WHOLE, "said"), WHOLE, (*PART, "said"), PLAIN)
    with pytest.raises(InputError, match=r"panoramas=true, but 1 of 3 pictures of images=DIR are twice as wide"):
        taken(True, WHOLE, PLAIN, PLAIN)


def test_their_headers_say_so(tmp_path):
    said = b'<x:xmpmeta><rdf:Description GPano:ProjectionType="equirectangular"/></x:xmpmeta>'
    for number in range(3):
        Image.new("RGB", (128, 64)).save(tmp_path / f"{number}.jpg", **({"xmp": said} if number else {}))
    assert [photograph.is_panorama for photograph in find_photographs(tmp_path)] == [False, True, True]


def test_a_pycolmap_that_does_not_know_them_is_named():
    old = SimpleNamespace(CameraModelId=SimpleNamespace(OPENCV=4), __version__="4.0.4")
    assert lens_of(old, photographs(PLAIN), "OPENCV") == "OPENCV"
    with pytest.raises(InputError, match=r"needs pycolmap 4\.1 or later, and 4\.0\.4 is installed"):
        lens_of(old, photographs((*WHOLE, "said")), "OPENCV")


def test_colmap_and_we_see_the_same_directions_in_them():
    pycolmap = pytest.importorskip("pycolmap", minversion="4.1")
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=64, height=32, params=[64, 32])
    cameras = panorama_cameras(torch.eye(4, dtype=torch.float64)[None, :3], 64, 32)
    pixels, zero = all_pixels(cameras, 0), torch.zeros(1)
    places = torch.stack([pixels.x + 0.5, pixels.y + 0.5], dim=-1).double().reshape(-1, 2).numpy()
    theirs = camera.cam_ray_from_img(places) @ FLIP
    ours = rays_through_pixels(cameras, pixels, zero, zero).directions.reshape(-1, 3).numpy()
    np.testing.assert_allclose(ours, theirs, atol=1e-6)


@pytest.mark.minutes
@pytest.mark.slow
def test_panoramas_of_a_room_are_placed_and_read_with_the_distances_of_its_walls(tmp_path):
    pytest.importorskip("pycolmap", minversion="4.1")
    true = write_room(tmp_path / "walk", count=9, height=HEIGHT)
    settings = SfmSettings(num_features=400)
    model, _ = from_photographs(tmp_path / "walk", tmp_path / "found", settings)
    assert (len(model.registered), model.left_out, model.num_cameras) == (9, (), 1)
    assert model.reprojection_error < 0.5
    poses = colmap_poses(tmp_path / "found" / "sparse" / "0")
    found = np.array([poses[name] for name in sorted(poses)])
    off, degrees = pose_errors(found, true)
    assert off.max() < 0.02 * SIZE.max()
    assert degrees.max() < 0.5

    # The folder is one of a known format now.
    scene = PhotosReader(root=str(tmp_path / "found"), cache_dir=str(tmp_path / "cache")).read()
    assert scene.cameras.lens_model == "equirectangular"
    assert len(scene.depths) > 400
    pixels, walls = scene.depths.pixels, []
    for view, x, y in torch.stack([pixels.view, pixels.x, pixels.y], dim=-1).numpy():
        toward = directions(true[view], x + 0.5, y + 0.5, height=HEIGHT)
        walls.append(to_walls(true[view][:, 3], toward).min())
    metres = unit_of(scene.to_user) * umeyama(found[:, :, 3], true[:, :, 3])[0] * scene.depths.distance.numpy()
    # Within a pixel, a wall at a grazing angle is here and there.
    assert np.median(np.abs(metres / np.array(walls) - 1.0)) < 0.01
