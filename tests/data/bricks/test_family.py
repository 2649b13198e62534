"""The family of random models: functions of their numbers, no two alike, where cameras and rays expect them."""

from pathlib import Path

import numpy as np
import pytest
import torch

from nerf_lightning.data.bricks.family import HALF, REACH, model
from nerf_lightning.data.bricks.light import DAY
from nerf_lightning.data.bricks.reader import BricksReader
from nerf_lightning.data.bricks.solids import Solids
from nerf_lightning.errors import InputError

SMALL = {"resolution": 16, "num_train": 2, "num_val": 0, "num_test": 0}


def read(folder: Path, variant: int) -> torch.Tensor:
    return BricksReader(variant=variant, **SMALL, cache_dir=str(folder)).read().pixels.rgba.float() / 255.0


def test_the_fire_engine_is_number_0_in_its_own_light_and_keeps_its_file(tmp_path: Path) -> None:
    """To the bit: the file's name stands for the pixels, and was made of these settings before there was a family."""
    assert model(0).light is DAY
    assert len(model(0).parts) == 238
    BricksReader(**SMALL, cache_dir=str(tmp_path)).read()
    assert [file.name for file in tmp_path.glob("*.npz")] == ["401381e4b296a378.npz"]


def test_a_number_has_one_model_and_one_file(tmp_path: Path) -> None:
    first = read(tmp_path / "a", 5)
    assert torch.equal(first, read(tmp_path / "b", 5))
    read(tmp_path / "a", 6)
    assert len(list((tmp_path / "a").glob("*.npz"))) == 2
    assert torch.equal(first, read(tmp_path / "a", 5))


def test_no_two_of_two_hundred_have_the_same_shape_colours_or_light() -> None:
    models = [model(variant) for variant in range(1, 209)]
    shapes = {tuple(sorted((part.solid.interval.__name__, part.size) for part in each.parts)) for each in models}
    colors = {tuple(sorted({part.material.color for part in each.parts})) for each in models}
    assert len(shapes) == 208
    assert len(colors) > 190
    assert len({tuple(each.light.key) for each in models}) == 208


def test_pictures_of_different_numbers_differ_visibly(tmp_path: Path) -> None:
    pictures = [read(tmp_path, variant) for variant in range(8)]
    for one in range(8):
        for other in range(one):
            both = torch.maximum(pictures[one][:, 3], pictures[other][:, 3]).sum()
            apart = (pictures[one] - pictures[other]).abs().amax(dim=1).sum()
            assert apart > 0.2 * both, (one, other)


def test_models_stand_where_cameras_look_and_lights_shine_from_above() -> None:
    for variant in range(1, 209):
        made = model(variant)
        corners = Solids.of(made.parts).corners().reshape(-1, 3)
        assert np.abs(corners).max() < HALF + 1e-9
        assert np.linalg.norm(corners, axis=1).max() < REACH + 1e-9
        assert np.ptp(corners, axis=0).max() > 0.8
        assert made.light.key[2] > 0.4
        assert np.linalg.norm(made.light.key) == pytest.approx(1.0)


def test_content_lies_in_the_box_that_the_scene_hands_out(tmp_path: Path) -> None:
    scene = BricksReader(variant=9, **SMALL, cache_dir=str(tmp_path)).read()
    found = torch.from_numpy(Solids.of(model(9).parts).corners().reshape(-1, 3))
    assert bool(((found > scene.aabb[0]) & (found < scene.aabb[1])).all())


def test_a_number_below_0_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"scene\.variant=-1"):
        read(tmp_path, -1)
