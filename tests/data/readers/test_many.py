"""Several captures as one scene: each view with its own camera, pixels, bounds and capture."""

from dataclasses import replace

import pytest
import torch
from support.posed_captures import Known, ring, write_transforms
from support.scenes import ball_scene

from nerf_lightning.data.bricks.reader import BricksReader
from nerf_lightning.data.captures.joined import joined, one_capture, shown_capture
from nerf_lightning.data.readers.many import ManyReader, numbers_in
from nerf_lightning.doctor.examine import examine
from nerf_lightning.errors import InputError
from nerf_lightning.nerf.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.nerf.types.scene import Scene

SMALL = {"resolution": 8, "num_train": 3, "num_val": 1, "num_test": 2}


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(tmp_path_factory.mktemp("bricks"))


@pytest.fixture(scope="module")
def scene(cache: str) -> Scene:
    return ManyReader(variants="1-2", unseen=7, **SMALL, cache_dir=cache).read()


def test_each_view_is_what_its_capture_has(scene: Scene, cache: str) -> None:
    assert scene.captures == ("bricks_1", "bricks_2", "bricks_7")
    for number, variant in enumerate((1, 2, 7)):
        alone = BricksReader(variant=variant, **SMALL, cache_dir=cache).read()
        for view in range(6):
            place = 6 * number + view
            assert scene.capture_of[place] == number
            assert scene.view_names[place] == f"bricks_{variant}/{alone.view_names[view]}"
            assert torch.equal(scene.pixels.view(place), alone.pixels.view(view))
            one, other = (
                rays_through_pixels(each.cameras, all_pixels(each.cameras, at), each.near, each.far)
                for each, at in ((scene, place), (alone, view))
            )
            assert torch.equal(one.origins, other.origins)
            assert torch.equal(one.directions, other.directions)
        assert bool((scene.aabb[0] <= alone.aabb[0]).all())
        assert bool((scene.aabb[1] >= alone.aabb[1]).all())


def test_nothing_of_an_unseen_capture_is_trained_on_and_it_alone_is_judged_by(scene: Scene) -> None:
    names = {split: [scene.view_names[view] for view in views] for split, views in scene.splits.items()}
    assert scene.trained_captures == ("bricks_1", "bricks_2")
    assert not any(name.startswith("bricks_7") for name in names["train"])
    assert all(name.startswith("bricks_7") for name in names["val"] + names["test"])
    assert sorted(set(names["sources"]) - set(names["train"])) == [f"bricks_7/train_00{view}" for view in range(3)]


def test_without_unseen_captures_each_is_judged_by_its_own(cache: str) -> None:
    scene = ManyReader(variants="1-2", **SMALL, cache_dir=cache).read()
    assert len(scene.splits["test"]) == 4
    assert scene.splits["sources"] == scene.splits["train"]
    assert scene.trained_captures == scene.captures


def test_one_of_the_captures_is_a_scene_again(scene: Scene, cache: str) -> None:
    alone = BricksReader(variant=7, **SMALL, cache_dir=cache).read()
    again = shown_capture(scene)
    assert again.name == "bricks_7"
    assert again.capture_of is None
    assert again.splits["train"] == alone.splits["train"]
    assert again.splits["test"] == alone.splits["test"]
    for view in range(6):
        assert torch.equal(again.pixels.view(view), alone.pixels.view(view))
    assert torch.equal(again.cameras.c2w, alone.cameras.c2w)
    assert one_capture(scene, 1).name == "bricks_2"


def test_a_folder_of_captures(tmp_path, cache: str) -> None:
    for name in ("bike", "duck"):
        write_transforms(tmp_path / "all" / name, Known(c2w=ring()))
    (tmp_path / "all" / "notes").mkdir()
    scene = ManyReader(root=str(tmp_path / "all"), unseen="d*", cache_dir=str(tmp_path / "cache")).read()
    assert scene.captures == ("bike", "duck")
    assert scene.trained_captures == ("bike",)
    with pytest.raises(InputError, match="is called horse; there are bike"):
        ManyReader(root=str(tmp_path / "all"), unseen="horse").read()


def test_captures_of_different_spaces_lenses_and_backgrounds_are_refused() -> None:
    one = ball_scene()
    other = replace(one, space="contracted")
    with pytest.raises(InputError, match=r"differ in their space \(bounded: a; contracted: b\)"):
        joined({"a": one, "b": other}, (), "both")
    with pytest.raises(InputError, match="differ in their background"):
        joined({"a": one, "b": replace(one, background="black")}, (), "both")
    fisheye = replace(one, cameras=replace(one.cameras, lens_model="fisheye"))
    with pytest.raises(InputError, match="differ in their kind of lens"):
        joined({"a": one, "b": fisheye}, (), "both")


def test_masks_of_some_captures_keep_all_of_the_others() -> None:
    one = ball_scene()
    mask = torch.zeros(len(one.pixels.rgba), dtype=torch.uint8)
    scene = joined({"a": one, "b": replace(one, pixels=replace(one.pixels, mask=mask))}, (), "both")
    kept = scene.pixels.kept(0), scene.pixels.kept(len(one.view_names))
    assert kept[0] is not None
    assert kept[1] is not None
    assert bool(kept[0].all())
    assert not bool(kept[1].any())


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({}, "needs a folder of captures"),
        ({"root": "x", "variants": "1-2"}, "not both"),
        ({"variants": "1-4", "unseen": "4-6"}, "names the bricks models 4, which"),
        ({"variants": "4-1"}, "give numbers and ranges"),
        ({"variants": "one"}, "give numbers and ranges"),
        ({"variants": "1-99999999999"}, "more than 10000 models"),
        ({"root": "/nowhere/at/all"}, "does not exist"),
    ],
)
def test_what_makes_no_scene_is_refused(settings, said) -> None:
    with pytest.raises(InputError, match=said):
        ManyReader(**settings).read()


def test_numbers_are_taken_once_and_in_order() -> None:
    assert numbers_in("3 1-4 3", "scene.variants") == [3, 1, 2, 4]


def test_planted_gain_and_gamma_change_colours_as_said_and_no_alpha(cache: str) -> None:
    plain = BricksReader(variant=1, **SMALL, cache_dir=cache).read().pixels.rgba.float()
    planted = BricksReader(variant=1, **SMALL, gain=0.7, gamma=1.6, cache_dir=cache).read().pixels.rgba.float()
    assert torch.equal(planted[:, 3], plain[:, 3])
    expected = 255.0 * 0.7 * (plain[:, :3] / 255.0) ** 1.6
    torch.testing.assert_close(planted[:, :3], expected, atol=0.51, rtol=0.0)


def test_the_doctor_examines_one_capture_at_a_time(scene: Scene) -> None:
    with pytest.raises(InputError, match="joins 3 captures, and the doctor examines one"):
        examine(scene)
