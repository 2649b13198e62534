"""The built-in scene: its solids against closed forms, its pictures against its geometry, its cache."""

import hashlib
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf_lightning.data.bricks import reader as reader_module
from nerf_lightning.data.bricks.light import DAY, cells, decode_srgb, encode_srgb, key_visible, openness, shade
from nerf_lightning.data.bricks.parts import ALONG_X, ALONG_Z, Material, ball, block, fire_engine, rod, slope
from nerf_lightning.data.bricks.reader import DISTANCE, PACKAGED, BricksReader, bricks_cameras, packaged_pictures
from nerf_lightning.data.bricks.shapes import BALL, BOX, CYLINDER, WEDGE
from nerf_lightning.data.bricks.solids import NOTHING, Solids
from nerf_lightning.data.bricks.tracer import SIDES, Pinhole, Tracer
from nerf_lightning.files import atomic
from nerf_lightning.files.atomic import MACHINE
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
PAINT = Material((0.5, 0.5, 0.5))


@pytest.fixture(scope="module")
def tracer() -> Tracer:
    return Tracer(fire_engine())


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return BricksReader(**SMALL, cache_dir=str(tmp_path_factory.mktemp("bricks"))).read()


def pinhole(scene: Scene, view: int) -> Pinhole:
    return Pinhole(scene.cameras.c2w[view].double().numpy(), float(scene.cameras.focal[view, 0]), 16)


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


@pytest.mark.parametrize("name", SIZES)
def test_normal_is_the_gradient_of_the_distance(name: str) -> None:
    solid, numbers = SIZES[name]
    origins, directions = random_rays(300)
    sizes = np.repeat(np.array(numbers)[:, None], 300, axis=1)
    entry, exit = solid.interval(origins, directions, sizes)
    hit = entry < exit
    points, sizes = (origins + np.where(hit, entry, 0) * directions)[:, hit], sizes[:, hit]
    normals = solid.normal(points, sizes)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=0), 1, atol=1e-9)
    np.testing.assert_allclose(solid.distance(points + 1e-3 * normals, sizes), 1e-3, atol=1e-6)
    assert (np.sum(normals * directions[:, hit], axis=0) < 0).all()


def test_closed_forms_along_an_axis() -> None:
    start, along = np.array([[0.0], [0], [-5]]), np.array([[0.0], [0], [1]])
    expected = {"box": (4.7, 5.3), "wedge": (4.7, 5.1875), "cylinder": (4.6, 5.4), "ball": (4.3, 5.7)}
    for name, (solid, numbers) in SIZES.items():
        interval = solid.interval(start, along, np.array(numbers)[:, None])
        assert [float(t[0]) for t in interval] == pytest.approx(expected[name])


def test_first_hit_sees_through_frames_and_picks_the_nearest() -> None:
    parts = [
        block((-1.0, -1.0, -1.0), (0.0, 1.0, 1.0), PAINT),
        rod((2.0, 0.0, 0.0), 0.5, 1.0, ALONG_X, PAINT),
        ball((0.0, 4.0, 0.0), 0.5, PAINT),
        rod((0.0, -4.0, 0.0), 0.5, 3.0, ALONG_Z, PAINT),
    ]
    solids = Solids.of(parts)
    origins = np.array([[9.0, 0, 0], [0, 9, 0], [0, -9, 1.4], [9, 0, 9]]).T
    directions = np.array([[-1.0, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, 1]]).T
    depth, number = solids.first_hit(origins, directions)
    assert number.tolist() == [1, 2, 3, NOTHING]
    np.testing.assert_allclose(depth, [6.5, 4.5, 4.5, np.inf])


def test_slope_keeps_what_lies_left_of_the_cut_and_its_shape_when_scaled() -> None:
    solids = Solids.of([slope((0.0, 0.0, 0.0), (2.0, 1.0, 2.0), (2.0, 0.0), (0.0, 2.0), PAINT)])
    points = np.array([[0.5, 0.5, 0.5], [1.5, 0.5, 1.5], [1.0, 0.5, 1.0]]).T
    np.testing.assert_allclose(solids.room(points, 9.0), [-0.5, np.sqrt(0.5), 0], atol=1e-12)
    part = slope((0.0, 0.0, 0.0), (2.0, 1.0, 2.0), (2.0, 0.0), (0.0, 2.0), PAINT)
    small = part.scaled(0.1, (1.0, 2.0, 3.0))
    assert small.center == pytest.approx((0.2, 0.25, 0.4))
    assert small.size[3:5] == part.size[3:5]
    assert vars(replace(small, size=part.size, center=part.center)) == vars(part)


def test_tiles_find_what_all_parts_find(tracer: Tracer, scene: Scene) -> None:
    view = pinhole(scene, 0)
    found = tracer.find(view, 2, tracer.solids)
    places = (np.arange(32) + 0.5) / 2
    y, x = (grid.reshape(-1) for grid in np.meshgrid(places, places, indexing="ij"))
    directions = view.directions(x, y)
    depth, part = tracer.solids.first_hit(view.c2w[:, 3:], directions)
    pixel = y.astype(int) * 16 + x.astype(int)
    hit = part != NOTHING
    assert sorted(zip(found.pixel, found.depth, found.part, strict=True)) == sorted(
        zip(pixel[hit], depth[hit], part[hit], strict=True)
    )


def test_alpha_counts_the_rays_that_hit(tracer: Tracer, scene: Scene) -> None:
    view = pinhole(scene, 1)
    rgba = tracer.pictures([view])[0]
    edges = np.flatnonzero((rgba[:, 3] > 0) & (rgba[:, 3] < 255))
    assert edges.size > 10
    steps = (np.arange(SIDES) + 0.5) / SIDES
    for pixel in edges[:10]:
        y, x = divmod(int(pixel), 16)
        rows, columns = np.meshgrid(y + steps, x + steps, indexing="ij")
        _, part = tracer.solids.first_hit(view.c2w[:, 3:], view.directions(columns.reshape(-1), rows.reshape(-1)))
        assert rgba[pixel, 3] == round(255 * (part != NOTHING).mean())


def test_sharing_a_call_changes_no_pixel(tracer: Tracer, scene: Scene) -> None:
    views = [pinhole(scene, i) for i in range(2)]
    together = tracer.pictures(views)
    alone = np.concatenate([tracer.pictures([view]) for view in views])
    np.testing.assert_array_equal(together, alone)


def test_culled_light_is_the_light_of_all_parts(tracer: Tracer, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    found = tracer.find(pinhole(scene, 4), 3, tracer.solids)
    normals = tracer.solids.normals(found.points, found.part)
    arguments = (tracer.solids, found.points, normals, found.ray)
    culled = key_visible(*arguments), openness(*arguments)
    monkeypatch.setattr(Solids, "only", lambda self, keep: self)
    np.testing.assert_array_equal(culled[0], key_visible(*arguments))
    assert 0.2 < culled[0].mean() < 0.9
    np.testing.assert_array_equal(culled[1], openness(*arguments))
    assert 0.3 < culled[1].mean() < 1


def test_cells_cover_each_point_once() -> None:
    places = np.random.default_rng(0).normal(size=(2, 500))
    members = list(cells(places, 0.5))
    assert sorted(np.concatenate(members).tolist()) == list(range(500))
    assert max(np.ptp(places[:, m], axis=1).max() for m in members) <= 0.5


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


def test_views_agree_on_the_surface(scene: Scene, tracer: Tracer) -> None:
    """No view sees further than a point that another view has seen on the same line, and many see that point."""
    found = tracer.find(pinhole(scene, 0), 1, tracer.solids)
    points = torch.from_numpy(found.points.T).float()
    other = pinhole(scene, 2)
    place = project(scene.cameras, 2, points).double().numpy()
    inside = ((place > 0) & (place < 16)).all(axis=1)
    depth, _ = tracer.solids.first_hit(other.c2w[:, 3:], other.directions(place[inside, 0], place[inside, 1]))
    distance = np.linalg.norm(found.points.T[inside] - other.c2w[:, 3], axis=1)
    assert np.quantile(depth - distance, 0.98) < 1e-3
    assert (np.abs(depth - distance) < 1e-3).mean() > 0.1


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


def test_colours_survive_the_code_and_highlights_move_with_the_view(tracer: Tracer) -> None:
    codes = np.linspace(0, 1, 256)
    np.testing.assert_allclose(encode_srgb(decode_srgb(codes)), codes, atol=1e-6)
    assert encode_srgb(np.array(0.214041)) == pytest.approx(0.5, abs=1e-5)
    directions = np.array([[0.0, 0.42, -0.7], [0.0, -0.55, 0.1], [-1.0, -0.72, -0.7]], np.float32)
    directions /= np.linalg.norm(directions, axis=0)
    ones = np.ones(3, np.float32)
    up = np.array([[0, 0, 0], [0, 0, 0], [1, 1, 1]], np.float32)
    colors = shade(tracer.palette, DAY, np.zeros(3, int), up, directions, ones, ones)
    assert np.ptp(colors, axis=1).max() > 0.02


def test_two_renderings_are_identical(scene: Scene, tmp_path: Path) -> None:
    again = BricksReader(**SMALL, cache_dir=str(tmp_path)).read()
    assert torch.equal(again.pixels.rgba, scene.pixels.rgba)
    for ours, theirs in zip(again.truth(3), scene.truth(3), strict=True):
        assert torch.equal(ours, theirs)


def test_one_of_many_readers_renders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    original = reader_module.render
    monkeypatch.setattr(reader_module, "render", lambda *given: calls.append(1) or original(*given))
    scenes: list[Scene] = []
    small = BricksReader(resolution=8, num_train=1, num_val=0, num_test=0, cache_dir=str(tmp_path))
    threads = [threading.Thread(target=lambda: scenes.append(small.read())) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(calls) == 1
    assert len(scenes) == 4
    assert all(torch.equal(scene.pixels.rgba, scenes[0].pixels.rgba) for scene in scenes)
    assert {path.suffix for path in tmp_path.iterdir()} == {".npz", ".lock"}


def test_what_a_killed_process_left_in_the_cache_is_replaced(tmp_path: Path) -> None:
    small = BricksReader(resolution=8, num_train=1, num_val=0, num_test=0, cache_dir=str(tmp_path))
    small.read()
    (path,) = tmp_path.glob("*.npz")
    sound = path.read_bytes()
    path.rename(path.with_name(f".{path.stem}.999999999_{MACHINE}.nerf_lightning.part.npz"))  # killed before that
    atomic.remove_leftovers.cache_clear()
    small.read()
    assert path.read_bytes() == sound
    assert {path.suffix for path in tmp_path.iterdir()} == {".npz", ".lock"}


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 not a zip", None], ids=["empty", "foreign", "cut"])
def test_damaged_cache_is_rendered_anew(damage: bytes | None, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    small = BricksReader(resolution=8, num_train=1, num_val=0, num_test=0, cache_dir=str(tmp_path))
    first = small.read()
    (path,) = tmp_path.glob("*.npz")
    sound = path.read_bytes()
    path.write_bytes(sound[: len(sound) // 2] if damage is None else damage)
    again = small.read()
    assert torch.equal(first.pixels.rgba, again.pixels.rgba)
    assert "is damaged" in caplog.text
    assert path.read_bytes()[:2] == b"PK"
    caplog.clear()
    small.read()
    assert not caplog.text


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
