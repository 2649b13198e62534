import io

import numpy as np
import pytest
import torch
from support.captures import npz_content, picture, pose, write_npz

from nerf_lightning.data.readers.npz import NpzReader
from nerf_lightning.messages.errors import InputError


def npy(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


@pytest.fixture
def path(tmp_path):
    return write_npz(tmp_path / "toy.npz")


def refused(path, message, **settings):
    with pytest.raises(InputError, match=message):
        NpzReader(str(path), **settings).read()


def test_reads_pictures_poses_and_focal(path):
    scene = NpzReader(str(path), name="toy").read()
    assert scene.splits == {"train": tuple(range(8)), "val": (8, 9), "test": (8, 9)}
    assert np.array_equal(scene.pixels.view(3)[..., :3].numpy(), picture(3, 6, 4)[..., :3])
    assert scene.pixels.rgba[:, 3].min() == 255
    assert torch.allclose(scene.cameras.c2w[2], torch.tensor(pose(2))[:3])
    assert scene.cameras.focal.unique().tolist() == [7.5]
    assert (scene.cameras.width[0], scene.cameras.height[0]) == (6, 4)
    assert (scene.name, scene.background, scene.truth) == ("toy", "black", None)
    assert scene.view_names[9] == "9"


@pytest.mark.parametrize("dtype", [np.uint8, np.float16, np.float64])
def test_reads_colours_of_other_types(path, dtype):
    images = npz_content()["images"]
    changed = np.rint(images * 255).astype(dtype) if dtype == np.uint8 else images.astype(dtype)
    pixels = NpzReader(str(write_npz(path, images=changed))).read().pixels
    assert np.array_equal(pixels.view(3)[..., :3].numpy(), picture(3, 6, 4)[..., :3])


def test_colours_are_rounded_not_cut(path):
    write_npz(path, images=np.full((10, 2, 2, 3), 0.4999, dtype=np.float32))
    assert NpzReader(str(path)).read().pixels.rgba[0].tolist() == [127, 127, 127, 255]
    write_npz(path, images=np.full((10, 2, 2, 3), 0.4978, dtype=np.float32))
    assert NpzReader(str(path)).read().pixels.rgba[0].tolist() == [127, 127, 127, 255]


def test_every_kth_view_is_held_out(path):
    scene = NpzReader(str(path), hold_every=4).read()
    assert scene.splits == {"train": (1, 2, 3, 5, 6, 7, 9), "val": (0, 4, 8), "test": (0, 4, 8)}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hold_every": -2}, r"scene.hold_every=-2 would leave no training views"),
        ({"hold_every": 1}, r"scene.hold_every=1 would leave no training views"),
        ({"train_fraction": 1.0}, r"leaves 10 for training and 0 for evaluation"),
    ],
)
def test_refuses_settings(path, settings, message):
    refused(path, message, **settings)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"focal": None, "poses": None}, r"toy.npz lacks poses, focal; it has images. It needs images \(n, h"),
        ({"poses": np.zeros((9, 4, 4))}, r"has 10 images but 9 poses; there must be one pose per image"),
        ({"poses": np.zeros((10, 4, 4))}, r"toy.npz: poses\[0\] does not end in the row 0 0 0 1"),
        ({"poses": np.zeros((10, 3, 4))}, r"toy.npz: the view 0 has a pose that is not a rotation"),
        ({"poses": np.full((10, 3, 4), np.nan)}, r"poses\[0\] holds NaN or infinity.* 10 of the 10 views"),
        ({"poses": np.full((10, 4, 4), "a")}, r"poses\[0\] is not a 4 x 4 matrix of numbers"),
        ({"images": np.zeros((10, 4, 6, 4))}, r"images has the shape \(10, 4, 6, 4\). It needs"),
        ({"images": np.zeros((10, 4, 6, 3), dtype=np.int64)}, r"images has the type int64, but it must be"),
        ({"images": np.full((10, 4, 6, 3), 200.0)}, r"images\[0\] has values outside 0..1 or NaN. Divide 0..255"),
        ({"focal": np.array([1.0, 2.0])}, r"focal must be one number of pixels"),
        ({"focal": np.array(-1.0)}, r"the view 0 has the focal length -1"),
    ],
)
def test_refuses_content(path, changed, message):
    refused(write_npz(path, **changed), message)


def test_an_image_with_nan_is_left_out(path, caplog):
    images = npz_content()["images"]
    images[2, 0, 0, 0] = np.nan
    assert "2" not in NpzReader(str(write_npz(path, images=images))).read().view_names
    assert "images[2] has values outside 0..1 or NaN" in caplog.text


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: b"", r"a.npz is damaged.*not one zip archive.*Remove it, and copy"),
        (lambda content: content[:2000], r"a.npz is damaged.*not one zip archive"),
        (lambda content: npy(np.zeros(3)), r"a.npz is damaged.* It needs images"),
    ],
)
def test_refuses_files_that_are_no_npz(tmp_path, damage, message):
    path = write_npz(tmp_path / "a.npz")
    path.write_bytes(damage(path.read_bytes()))
    refused(path, message)


def test_refuses_an_absent_file(tmp_path):
    refused(tmp_path / "a.npz", r"a.npz does not exist; the folder holds nothing. Put")
