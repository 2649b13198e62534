"""The built-in scene: its solids against closed forms, its pictures against its geometry, its cache."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf_lightning.data.bricks.parts import fire_engine
from nerf_lightning.data.bricks.reader import DISTANCE, PACKAGED, BricksReader, bricks_cameras, packaged_pictures
from nerf_lightning.data.bricks.shapes import BALL, BOX, CYLINDER, WEDGE
from nerf_lightning.data.bricks.tracer import Pinhole, Tracer
from nerf_lightning.files.folders import default_folder
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import all_pixels, project, rays_through_pixels
from nerf_lightning.nerf.geometry.poses import is_rigid
from nerf_lightning.nerf.types.scene import Scene

SIZES = {
    "box": (BOX, [0.5, 0.8, 0.3]),
    "wedge": (WEDGE, [0.5, 0.8, 0.3, 0.6, 0.8, 0.15]),
    "cylinder": (CYLINDER, [0.6, 0.4]),
    "ball": (BALL, [0.7]),
}
SMALL = {"resolution": 16, "num_train": 3, "num_val": 1, "num_test": 2}


@pytest.fixture(scope="module")
def tracer() -> Tracer:
    return Tracer(fire_engine())


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return BricksReader(**SMALL, cache_dir=str(tmp_path_factory.mktemp("bricks"))).read()


def random_rays(count: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(3)
    origins = generator.normal(size=(3, count))
    origins *= 3 / np.linalg.norm(origins, axis=0)
    directions = generator.uniform(-1, 1, size=(3, count)) - origins
    return origins, directions / np.linalg.norm(directions, axis=0)


@pytest.mark.parametrize("name", SIZES)
def test_interval_agrees_with_marching_the_distance(name: str) -> None:
    solid, numbers = SIZES[name]
    size = np.array(numbers)[:, None]
    origins, directions = random_rays(200)
    entry, exit = solid.interval(origins, directions, size)
    travelled = np.zeros(200)
    for _ in range(2000):
        travelled += np.maximum(solid.distance(origins + travelled * directions, size), 0)
        travelled = np.minimum(travelled, 10)
    hit = entry < exit
    assert 40 < hit.sum() < 190
    np.testing.assert_allclose(travelled[hit], entry[hit], atol=1e-4)
    assert (travelled[~hit] > 9).all()
    leaving = origins + exit * directions
    np.testing.assert_allclose(solid.distance(leaving[:, hit], size), 0, atol=1e-9)


def test_truth_lies_on_the_surface_and_faces_the_camera(scene: Scene, tracer: Tracer) -> None:
    for view in range(6):
        pixels = all_pixels(scene.cameras, view).map(lambda x: x.reshape(-1))
        rays = rays_through_pixels(scene.cameras, pixels, scene.near, scene.far)
        depth, normals = scene.truth(view)
        hit = depth.isfinite()
        assert ((depth > scene.near[0]) & (depth < scene.far[0]))[hit].all()
        points = (rays.origins + depth[:, None] * rays.directions)[hit]
        room = tracer.solids.room(points.T.double().numpy(), 1.0)
        assert np.abs(room).max() < 2e-5
        assert ((points > scene.aabb[0]) & (points < scene.aabb[1])).all()
        torch.testing.assert_close(normals[hit].norm(dim=-1), torch.ones(int(hit.sum())))
        assert ((normals * rays.directions).sum(dim=-1)[hit] < 0).all()
        assert (normals[~hit] == 0).all()


def test_cameras_look_at_the_origin_from_the_upper_hemisphere() -> None:
    cameras = bricks_cameras(100, 20, 25, 128)
    eyes = cameras.c2w[:, :, 3]
    assert is_rigid(cameras.c2w, 1e-5).all()
    torch.testing.assert_close(eyes.norm(dim=-1), torch.full((145,), DISTANCE))
    assert (eyes[:, 2] > 0.1).all()
    assert (eyes[:, :2].norm(dim=-1) > 0.5).all()
    for view in range(145):
        torch.testing.assert_close(
            project(cameras, view, torch.zeros(3)), torch.tensor([64.0, 64.0]), atol=1e-3, rtol=0
        )
    between = torch.cdist(eyes, eyes) + 9 * torch.eye(145)
    assert between.min() > 0.05
    assert between[:100, :100].min() > 0.3
    assert float(cameras.focal[0, 0]) == pytest.approx(128 / 800 * 1111.111, rel=1e-5)


def test_scene_is_named_split_and_boxed_and_transparent_pixels_are_black(scene: Scene) -> None:
    assert scene.splits == {"train": (0, 1, 2), "val": (3,), "test": (4, 5)}
    assert scene.view_names == ("train_000", "train_001", "train_002", "val_000", "test_000", "test_001")
    assert scene.protocol["filter"] == "4x4 supersampling"
    assert scene.pixels.view(5).shape == (16, 16, 4)
    assert (scene.aabb.abs() < 1.25).all()
    assert (scene.aabb[1] - scene.aabb[0] > 1).all()
    rgba = scene.pixels.rgba
    empty = rgba[:, 3] == 0
    assert 0.3 < empty.float().mean() < 0.95
    assert (rgba[empty] == 0).all()
    assert (rgba[~empty, :3].sum(dim=-1) > 0).all()
    depth = torch.cat([scene.truth(view).depth for view in range(6)])
    assert (rgba[depth.isfinite(), 3] > 0).float().mean() > 0.98


def test_the_fire_engine_keeps_its_parts_and_its_file(tmp_path: Path) -> None:
    """The file's name stands for the pixels."""
    numbers = [[*part.size, *part.center, *part.frame.flat, *part.material.color] for part in fire_engine()]
    assert len(numbers) == 238
    digest = hashlib.sha256((np.concatenate(numbers).round(6) + 0.0).tobytes()).hexdigest()
    assert digest[:16] == "b09e1dec1e67790a"
    BricksReader(resolution=16, num_train=2, num_val=0, num_test=0, cache_dir=str(tmp_path)).read()
    assert [file.name for file in tmp_path.glob("*.npz")] == ["401381e4b296a378.npz"]


def test_unwritable_cache_costs_a_warning_and_its_folder_follows_the_environment(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    small = BricksReader(resolution=8, num_train=1, num_val=0, num_test=0, cache_dir=str(blocked / "bricks"))
    assert small.read().pixels.rgba.shape == (64, 4)
    assert "rendered again" in caplog.text
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.delenv("NERF_LIGHTNING_CACHE", raising=False)
    assert default_folder("bricks") == tmp_path / "xdg" / "nerf_lightning" / "bricks"
    monkeypatch.setenv("NERF_LIGHTNING_CACHE", str(tmp_path / "own"))
    assert default_folder("bricks") == tmp_path / "own" / "bricks"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"resolution": 0}, "scene.resolution=0: give 1 or more"),
        ({"num_train": 0}, "scene.num_train=0: give 1 or more"),
        ({"num_test": -1}, "scene.num_test=-1: give 0 or more"),
        ({"near": 6.0, "far": 2.0}, "scene.near=6.0 and scene.far=2.0: near must be 0 or more and less than far"),
        ({"background": "pink"}, "scene.background is 'pink'; choose one of white, black, random, white_or_random,"),
    ],
)
def test_wrong_arguments_are_explained(arguments: dict[str, object], message: str) -> None:
    reader = BricksReader()
    vars(reader).update(arguments)
    with pytest.raises(InputError, match=message):
        reader.read()


def test_the_pictures_in_the_package_are_those_that_are_rendered(tracer: Tracer) -> None:
    counts = {split: PACKAGED[split] for split in ("train", "val", "test")}
    cameras, pictures = bricks_cameras(**counts, resolution=PACKAGED["resolution"]), packaged_pictures()
    pictures = pictures.reshape(sum(counts.values()), PACKAGED["resolution"] ** 2, 4)
    shown = [0, 107, 144]
    views = [Pinhole(cameras.c2w[i].double().numpy(), float(cameras.focal[i, 0]), 128) for i in shown]
    for view, picture in zip(views, pictures[shown], strict=True):
        assert np.abs(tracer.pictures([view])[0].astype(int) - picture).max() <= 1  # other CPUs may round otherwise
