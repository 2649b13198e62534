"""Random models of bricks, several captures as one scene, and a model that learns from them."""

import hashlib
import json

import numpy as np
import pytest
import torch
from support.made_once import made_once
from support.posed_captures import Known, ring, write_transforms
from support.running import FAST, said, start

from nerf_lightning.data.bricks.solids import Solids
from nerf_lightning.extensions.many_scenes.brick_models import HALF, REACH, BrickModelReader, model
from nerf_lightning.extensions.many_scenes.many import ManyReader, numbers_in
from nerf_lightning.messages.errors import InputError

SMALL = {"resolution": 8, "num_train": 3, "num_val": 1, "num_test": 2}
PICTURES = ("scene.resolution=16", "scene.num_train=5", "scene.num_val=1", "scene.num_test=1")
FAST_MANY = (
    *(each for each in FAST if not each.startswith(("model=", "data.crop", "trainer.tile_points"))),
    "model=view_transformer_tiny", "model.width=8", "model.heads=2", "model.num_sources=3",
    "model.sampler.num_samples=6", "model.image_features=4", "model.image_width=4", "model.image_blocks=0",
    "model.experts=3", "data.views_per_step=2", "data.crop_steps=0", "trainer.precision=32-true",
    "trainer.num_threads=1", "logger=none",
)  # fmt: skip


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return str(tmp_path_factory.mktemp("bricks"))


def test_each_number_keeps_its_model_and_its_light():
    """The first 208 are those of experiment=many_bricks."""
    digest = hashlib.sha256()
    for number in range(1, 209):
        made = model(number)
        corners = Solids.of(made.parts).corners().reshape(-1, 3)
        assert np.abs(corners).max() < HALF + 1e-9
        assert np.linalg.norm(corners, axis=1).max() < REACH + 1e-9
        assert made.light.key[2] > 0.4
        numbers = [[*part.size, *part.center, *part.frame.flat, *part.material.color] for part in made.parts]
        digest.update((np.concatenate([*numbers, made.light.key]).round(6) + 0.0).tobytes())
    assert digest.hexdigest()[:16] == "add615c169391caf"


def test_several_are_one_scene_of_which_the_unseen_are_never_trained_on(cache):
    scene = ManyReader(variants="1-2", unseen=7, **SMALL, cache_dir=cache).read()
    assert scene.captures == ("bricks_1", "bricks_2", "bricks_7")
    assert scene.trained_captures == ("bricks_1", "bricks_2")
    alone = BrickModelReader(variant=7, **SMALL, cache_dir=cache).read()
    for view in range(6):
        assert scene.view_names[12 + view] == f"bricks_7/{alone.view_names[view]}"
        assert torch.equal(scene.pixels.view(12 + view), alone.pixels.view(view))


def test_planted_gain_and_gamma_change_colours_as_said_and_no_alpha(cache):
    plain = BrickModelReader(variant=1, **SMALL, cache_dir=cache).read().pixels.rgba.float()
    planted = BrickModelReader(variant=1, **SMALL, gain=0.7, gamma=1.6, cache_dir=cache).read().pixels.rgba.float()
    assert torch.equal(planted[:, 3], plain[:, 3])
    expected = 255.0 * 0.7 * (plain[:, :3] / 255.0) ** 1.6
    torch.testing.assert_close(planted[:, :3], expected, atol=0.51, rtol=0.0)


def test_a_folder_of_captures(tmp_path, cache):
    for name in ("bike", "duck"):
        write_transforms(tmp_path / "all" / name, Known(c2w=ring()))
    scene = ManyReader(root=str(tmp_path / "all"), unseen="d*", cache_dir=cache).read()
    assert (scene.captures, scene.trained_captures) == (("bike", "duck"), ("bike",))
    with pytest.raises(InputError, match="is called horse; there are bike"):
        ManyReader(root=str(tmp_path / "all"), unseen="horse").read()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, "needs a folder of captures"),
        ({"root": "x", "variants": "1-2"}, "not both"),
        ({"variants": "1-4", "unseen": "4-6"}, "names the bricks models 4, which"),
        ({"variants": "4-1"}, "give numbers and ranges"),
        ({"variants": "1-99999999999"}, "more than 10000 models"),
        ({"root": "/nowhere/at/all"}, "does not exist"),
    ],
)
def test_what_makes_no_scene_is_refused(settings, words):
    with pytest.raises(InputError, match=words):
        ManyReader(**settings).read()
    assert numbers_in("3 1-4 3", "scene.variants") == [3, 1, 2, 4]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Four steps on two models of bricks, judged on a third."""

    def train(folder):
        process = start("train", "scene=many", "scene.variants=1-2", "scene.unseen=201", *PICTURES, *FAST_MANY,
                        "evaluation.nearest_views=2", "path.width=16", f"paths.output_dir={folder}/run")  # fmt: skip
        output, _ = process.communicate(timeout=300)
        assert process.returncode == 0, output
        assert "no model     nearest photograph" in output

    return made_once(tmp_path_factory, "many_scenes", train) / "run"


@pytest.mark.minutes
def test_a_run_is_judged_on_a_scene_that_it_never_saw_and_renders_others(nerf, run, tmp_path):
    assert list(json.loads((run / "metrics.json").read_text())["captures"]) == ["bricks_201"]
    assert (run / "video.mp4").stat().st_size > 0
    other = ("scene=brick_model", "scene.variant=202", *PICTURES)
    result = nerf("eval", f"ckpt={run}", *other, f"paths.output_dir={tmp_path}/other", "trainer=cpu")
    assert result.code == 0, result.err
    metrics = json.loads((tmp_path / "other" / "metrics.json").read_text())
    assert metrics["origin"]["trained_on"] == ["bricks_1", "bricks_2"]
    few = [each.replace("num_train=5", "num_train=2") for each in other]
    said(nerf("render", f"ckpt={run}", *few, f"paths.output_dir={tmp_path}/a"), "renders each view from 3 photographs")


@pytest.mark.parametrize("what", ["mesh", "page"])
def test_what_needs_density_is_refused_by_name(nerf, run, tmp_path, what):
    result = nerf("export", f"ckpt={run}", f"what={what}", f"paths.output_dir={tmp_path}/out", "trainer=cpu")
    said(result, "ViewTransformer renders rays and has neither density nor color")
    assert not (tmp_path / "out").exists()
