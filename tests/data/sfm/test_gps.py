"""Scale, up and north from the GPS that photographs carry."""

import numpy as np
import pytest
from PIL import Image

from nerf_lightning.data.sfm.gps import align_to_gps, gps_of, in_metres

pycolmap = pytest.importorskip("pycolmap", reason="cameras are found with pycolmap")
PLACE = (47.3769, 8.5417, 408.0)


def photograph(path, place):
    """Write a photograph that says where it was taken."""
    exif = Image.Exif()
    gps = exif.get_ifd(0x8825)
    for key, value, names in ((1, place[0], "NS"), (3, place[1], "EW")):
        degrees, rest = divmod(abs(value), 1)
        minutes, rest = divmod(60 * rest, 1)
        gps[key], gps[key + 1] = names[int(value < 0)], (float(degrees), float(minutes), 60.0 * float(rest))
    gps[5], gps[6] = b"\x01" if place[2] < 0 else b"\x00", abs(float(place[2]))
    Image.new("RGB", (8, 8)).save(path, exif=exif)


def places_around(metres):
    """Return latitude, longitude and height of points in meters east, north and up from a place."""
    return [
        (PLACE[0] + north / 111_190, PLACE[1] + east / (111_320 * np.cos(np.radians(PLACE[0])) * 1.0018), PLACE[2] + up)
        for east, north, up in metres
    ]


@pytest.mark.parametrize("place", [PLACE, (-33.8568, -151.2153, -3.5)])
def test_a_photograph_says_where_it_was_taken(tmp_path, place):
    photograph(tmp_path / "a.jpg", place)
    assert gps_of(tmp_path / "a.jpg") == pytest.approx(place, abs=1e-5)


def test_a_photograph_without_gps_says_nothing(tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg")
    assert gps_of(tmp_path / "a.jpg") is None
    (tmp_path / "b.jpg").write_bytes(b"no picture")
    assert gps_of(tmp_path / "b.jpg") is None


def test_degrees_become_metres():
    found = in_metres(places_around([(-100, 0, 0), (100, 0, 0), (0, -50, 7), (0, 50, -7)]))
    np.testing.assert_allclose(found, [(-100, 0, 0), (100, 0, 0), (0, -50, 7), (0, 50, -7)], atol=0.3)
    across = in_metres([(0.0, 179.9995, 0.0), (0.0, -179.9995, 0.0)])
    assert np.abs(across[:, 0]) == pytest.approx(55.7, abs=0.1)


def synthetic(folder, spread, noise):
    """Return a model of cameras whose photographs say where they are, in meters."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 12, 40
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    images = [model.image(number) for number in model.reg_image_ids()]
    centers = np.stack([image.projection_center() for image in images])
    true = spread * (centers - centers.mean(axis=0))
    said = true + np.random.default_rng(0).normal(0, noise, true.shape)
    for image, place in zip(images, places_around(said), strict=True):
        image.name = f"{image.image_id}.jpg"
        photograph(folder / image.name, place)
    return model, [image.name for image in images], true


def test_a_model_is_brought_into_metres(tmp_path):
    model, names, true = synthetic(tmp_path, spread=20.0, noise=0.5)
    assert align_to_gps(pycolmap, model, tmp_path)
    by_name = {image.name: image for image in model.images.values()}
    found = np.stack([by_name[name].projection_center() for name in names])
    assert np.abs(found - found.mean(axis=0) - true).max() < 2.0


def test_places_as_near_as_they_are_off_say_nothing(tmp_path):
    model, *_ = synthetic(tmp_path, spread=0.3, noise=3.0)
    before = model.image(model.reg_image_ids()[0]).projection_center().copy()
    assert not align_to_gps(pycolmap, model, tmp_path)
    assert np.array_equal(model.image(model.reg_image_ids()[0]).projection_center(), before)
    assert not align_to_gps(pycolmap, model, tmp_path / "elsewhere")
