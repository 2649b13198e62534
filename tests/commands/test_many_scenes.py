"""One model for many scenes, from its training to scenes that it has never seen."""

import json

import pytest
import torch
from support.made_once import made_once
from support.running import FAST, said, start

PICTURES = ("scene.resolution=16", "scene.num_train=5", "scene.num_val=1", "scene.num_test=1")
OTHER = ("scene=bricks", "scene.variant=202", *PICTURES)
FAST_MANY = (
    *(each for each in FAST if not each.startswith(("model=", "data.crop", "trainer.tile_points"))),
    "model=view_transformer_tiny", "model.width=8", "model.heads=2", "model.num_sources=3",
    "model.sampler.num_samples=6", "model.image_features=4", "model.image_width=4", "model.image_blocks=0",
    "model.experts=3",
    "data.views_per_step=2", "data.crop_steps=0", "trainer.precision=32-true", "trainer.num_threads=1",
    "logger=none",
)  # fmt: skip


def succeeds(result, part):
    """Expect exit code 0, and these words."""
    assert result.code == 0, result.err
    assert part in result.out


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Four steps on two models of bricks, judged on a third."""

    def train(folder):
        process = start("train", "scene=many", "scene.variants=1-2", "scene.unseen=201", *PICTURES, *FAST_MANY,
                        "evaluation.nearest_views=2", "path.width=16", f"paths.output_dir={folder}/run")  # fmt: skip
        output, _ = process.communicate(timeout=300)
        assert process.returncode == 0, output
        (folder / "output.txt").write_text(output)

    return made_once(tmp_path_factory, "many_scenes", train) / "run"


def test_a_run_is_judged_by_name_on_scenes_that_it_never_saw_and_films_one_of_them(run):
    metrics = json.loads((run / "metrics.json").read_text())
    assert list(metrics["captures"]) == ["bricks_201"]
    assert metrics["captures"]["bricks_201"]["trained_on"] is False
    output = (run.parent / "output.txt").read_text()
    assert "no model     nearest photograph" in output
    assert "bricks_201 is shown" in output
    assert (run / "video.mp4").stat().st_size > 0


def test_its_checkpoint_names_the_scenes_of_its_training(run):
    record = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["nerf_lightning"]["scene"]
    assert record["captures"] == ("bricks_1", "bricks_2", "bricks_201")
    trained = {record["captures"][record["capture_of"][view]] for view in record["splits"]["train"]}
    assert trained == {"bricks_1", "bricks_2"}


def test_it_is_measured_on_its_own_scenes_again_and_on_one_that_is_named(nerf, run, tmp_path):
    own = nerf("eval", f"ckpt={run}", f"paths.output_dir={tmp_path}/own", "trainer=cpu", "trainer.precision=32-true")
    succeeds(own, "test PSNR")
    trained = json.loads((run / "metrics.json").read_text())
    again = json.loads((tmp_path / "own" / "metrics.json").read_text())
    assert again["psnr"] == pytest.approx(trained["psnr"], abs=1e-3)
    other = nerf("eval", f"ckpt={run}", *OTHER, f"paths.output_dir={tmp_path}/other", "trainer=cpu")
    succeeds(other, "test PSNR")
    metrics = json.loads((tmp_path / "other" / "metrics.json").read_text())
    assert metrics["protocol"]["scene"] == "bricks"
    assert metrics["origin"]["trained_on"] == ["bricks_1", "bricks_2"]


def test_it_films_a_scene_that_it_has_never_seen_from_its_photographs(nerf, run, tmp_path):
    film = ("path.num_frames=2", "path.width=16", "format=frames", "trainer=cpu")
    pictures = []
    for name, scene in (("own", ()), ("other", OTHER)):
        result = nerf("render", f"ckpt={run}", *scene, *film, f"paths.output_dir={tmp_path}/{name}")
        succeeds(result, "video")
        pictures.append(sorted((tmp_path / name / "video").glob("*.png"))[0].read_bytes())
    assert pictures[0] != pictures[1]


def test_what_needs_density_is_refused_by_name(nerf, run, tmp_path):
    for what in ("mesh", "points", "volume", "page"):
        result = nerf("export", f"ckpt={run}", f"what={what}", f"paths.output_dir={tmp_path}/{what}", "trainer=cpu")
        assert result.code == 2
        assert "Traceback" not in result.err
        assert "model=view_transformer makes pictures of rays" in result.err.splitlines()[-1]
        assert not (tmp_path / what).exists()


def test_what_is_seen_is_exported(nerf, run, tmp_path):
    succeeds(nerf("export", f"ckpt={run}", "what=images", f"paths.output_dir={tmp_path}", "trainer=cpu"), "depth")
    assert len(list((tmp_path / "depth").glob("*.png"))) == 1


def test_a_model_of_one_scene_takes_no_other(nerf, finished_run, tmp_path):
    result = nerf("render", f"ckpt={finished_run}", *OTHER, f"paths.output_dir={tmp_path}/film")
    said(result, "knows the scene")
    assert not (tmp_path / "film").exists()


def test_a_scene_of_fewer_photographs_than_it_looks_at_is_refused(nerf, run, tmp_path):
    few = [each.replace("num_train=5", "num_train=2") for each in OTHER]
    result = nerf("render", f"ckpt={run}", *few, f"paths.output_dir={tmp_path}/film")
    said(result, "renders each view from 3 photographs")


@pytest.mark.slow
@pytest.mark.exhaustive
def test_it_begins_with_another_runs_weights_on_a_new_scene_and_goes_on_after_a_stop(nerf, run, tmp_path):
    # One rate all along: it would follow the length of the run, which is another one here.
    tuned = (
        "train",
        *OTHER,
        *FAST_MANY,
        "scheduler.decay_rate=1.0",
        f"init_from={run}",
        "final.video=false",
        f"paths.output_dir={tmp_path}/run",
    )
    succeeds(nerf(*tuned, "trainer.max_steps=2"), "test PSNR")
    succeeds(nerf(*tuned, "trainer.max_steps=4", "resume=auto"), "test PSNR")
    whole = [each.replace(f"{tmp_path}/run", f"{tmp_path}/whole") for each in tuned]
    succeeds(nerf(*whole, "trainer.max_steps=4"), "test PSNR")
    stopped, never = (
        torch.load(tmp_path / name / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
        for name in ("run", "whole")
    )
    assert all(torch.equal(stopped[name], value) for name, value in never.items())
