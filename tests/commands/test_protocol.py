"""The stamp on every number: what it holds, what changes it, and what keeps two results apart."""

import json

import pytest
import torch
from support.scenes import ball_scene, tiny_model

from nerf_lightning import __version__
from nerf_lightning.evaluation.protocol import config_hash, differences, measured_how, measured_of, weights_hash

MEASURED = {"scene": "a", "split": "test", "background": "white", "pixels": "float", "lpips": None}


def test_the_protocol_says_all_that_moves_a_number_and_the_origin_whose_it_is():
    scene = ball_scene()
    how = measured_how(scene, "test", [3, 4], "random", quantize=True, lpips="vgg")
    assert how["background"] == "white"
    assert how["resolution"] == [[12, 12]]
    assert (how["pixels"], how["masks"], how["cameras"], how["lpips"]) == ("8-bit", "none", "raw", "vgg, version 0.1")
    fewer = measured_how(scene, "test", [3], "random", quantize=True, lpips="vgg")
    assert differences(how, fewer) == [f"split_hash: {how['split_hash']} and {fewer['split_hash']}"]
    config = "seed: 3\noptimizer:\n  lr: 1\n"
    of = measured_of(tiny_model(), config, {"model": "nerf_tiny", "scene": "npz"}, torch.device("cpu"), "32-true")
    assert (of["model"], of["scene"], of["seed"], of["version"]) == ("nerf_tiny", "npz", 3, __version__)
    assert (of["device"], of["precision"]) == ("cpu", "32-true")
    parameters = sum(each.numel() for each in tiny_model().parameters())
    assert of["parameters"] == parameters
    assert of["megabytes"] == pytest.approx(4 * parameters / 1e6, abs=1e-3)


def test_one_weight_changes_the_checkpoints_name_and_the_order_of_names_does_not():
    weights = tiny_model().state_dict()
    name = weights_hash(weights)
    assert name == weights_hash(dict(reversed(weights.items())))
    changed = {key: tensor.clone() for key, tensor in weights.items()}
    next(each for name, each in changed.items() if name.endswith("weight")).view(-1)[0] += 1e-6
    assert weights_hash(changed) != name
    of_all_kinds = {"flag": torch.tensor(True), "none": torch.zeros(0), "half": torch.zeros(3, dtype=torch.bfloat16)}
    assert len(weights_hash(of_all_kinds)) == 16


@pytest.mark.parametrize(
    ("key", "value", "is_same"),
    [
        ("seed", 1, True),
        ("trainer.accelerator", "gpu", True),
        ("scene.root", "elsewhere", True),
        ("evaluation.split", "val", True),
        ("trainer.max_steps", 7, False),
        ("optimizer.lr", 0.5, False),
        ("scene.downscale", 2, False),
    ],
)
def test_the_config_hash_is_of_what_is_learnt(key, value, is_same):
    settings = {"seed": 0, "optimizer": {"lr": 1.0}, "trainer": {"max_steps": 5}, "scene": {"root": "here"}}
    group, _, name = key.rpartition(".")
    changed = settings | ({group: settings.get(group, {}) | {name: value}} if group else {name: value})
    assert (config_hash(changed) == config_hash(settings)) == is_same


def test_what_keeps_two_results_apart_is_named():
    assert differences(MEASURED, MEASURED) == []
    assert differences(MEASURED, MEASURED | {"pixels": "8-bit"}) == ["pixels: float and 8-bit"]
    assert differences(MEASURED, MEASURED | {"filter": "area"}) == ["filter: not said and area"]
    assert differences(MEASURED, MEASURED | {"lpips": "vgg"}) == []
    assert differences(MEASURED | {"lpips": "alex"}, MEASURED | {"lpips": "vgg"}) == ["lpips: alex and vgg"]
    other = MEASURED | {"scene": "b", "background": "black", "pixels": "8-bit"}
    assert differences(MEASURED, other, same_scene=False) == ["pixels: float and 8-bit"]


def test_metrics_have_median_worst_speed_and_pictures_of_the_worst(finished_run):
    metrics = json.loads((finished_run / "metrics.json").read_text())
    rows = sorted(metrics["per_image"], key=lambda row: row["psnr"])
    assert metrics["worst_views"] == [row["name"] for row in rows]
    assert metrics["worst"]["psnr"] == {"name": rows[0]["name"], "value": rows[0]["psnr"]}
    assert metrics["median"]["psnr"] == pytest.approx((rows[0]["psnr"] + rows[1]["psnr"]) / 2)
    assert metrics["frames_per_second"] == pytest.approx(2 / (rows[0]["seconds"] + rows[1]["seconds"]))
    assert metrics["peak_memory_gigabytes"] > 0.05
    images = finished_run / "images"
    assert (images / "worst_1.png").is_file()
    for view in ("worst_1", "worst_2"):
        assert {file.stem for file in (images / "views" / view).iterdir()} == {"truth", "render", "depth", "error"}
    note = json.loads((finished_run / "run.json").read_text())
    assert note["training_seconds"] > 0
    assert note["setup_seconds"] > 0
    assert note["training_seconds"] + note["setup_seconds"] <= note["seconds"] + 0.2
