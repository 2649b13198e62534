"""The main job, end to end: what a run folder holds, and what eval and render make of its checkpoint."""

import csv
import json

import imageio.v3 as iio
import pytest
import torch
from support.configs import composed
from support.running import done
from support.videos import read_video
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from nerf_lightning.evaluation.main_numbers import metric_lines


def events(folder):
    everything = dict.fromkeys(("tensors", "images", "scalars", "histograms"), 0)
    return EventAccumulator(str(folder / "tensorboard"), size_guidance=everything).Reload()


def test_a_run_folder_has_everything_and_the_end_says_where(finished_run):
    for name in (
        *("metrics.json", "metrics.csv", "checkpoints/last.ckpt", "checkpoints/best.ckpt", ".hydra/config.yaml"),
        *("video.mp4", "depth.mp4", "progress.mp4", "train.log"),
    ):
        assert (finished_run / name).stat().st_size > 0, name
    assert len(list((finished_run / "images").glob("test_*.png"))) == 1
    assert len(list((finished_run / "images" / "validation").glob("*.png"))) == 2
    output = (finished_run / "output.txt").read_text()
    metrics = json.loads((finished_run / "metrics.json").read_text())
    assert f"test PSNR    {metrics['psnr']:.2f} dB   SSIM {metrics['ssim']:.4f}" in output
    assert str(finished_run / "video.mp4") in output
    assert "LPIPS" not in output  # the report says what it needs
    assert f"tensorboard --logdir {finished_run / 'tensorboard'}" in output
    _, frames = read_video(finished_run / "video.mp4")
    assert frames.shape == (2, 16, 16, 3)
    content = torch.load(finished_run / "checkpoints" / "last.ckpt", weights_only=True)
    assert "model.levels.fine.field.color_head.weight" in content["state_dict"]
    assert content["global_step"] == 20


def test_metrics_carry_their_protocol(finished_run):
    metrics = json.loads((finished_run / "metrics.json").read_text())
    assert metrics["num_images"] == 2
    assert metrics["lpips"] is None
    assert "evaluation.lpips=alex" in metrics["lpips_hint"]
    assert metrics["psnr"] == pytest.approx(sum(row["psnr"] for row in metrics["per_image"]) / 2)
    protocol = metrics["protocol"]
    assert protocol["background"] == "black"
    assert protocol["resolution"] == [[16, 16]]
    assert protocol["split"] == "test"
    assert protocol["pixels"] == "float"
    assert len(protocol["split_hash"]) == 16
    rows = list(csv.DictReader((finished_run / "metrics.csv").read_text().splitlines()))
    assert [row["name"] for row in rows] == [row["name"] for row in metrics["per_image"]]


def test_tensorboard_has_scalars_pictures_config_histograms_and_a_row_of_hyper_parameters(finished_run):
    log = events(finished_run)
    tags = log.Tags()
    assert {
        *("PSNR/train_coarse", "PSNR/train_fine", "PSNR/validation", "PSNR/test"),
        *("Training loss/sum", "Training loss/coarse", "Training loss/fine"),
        "train/learning_rate",
        "speed/rays_per_second",
    } <= set(tags["scalars"])
    assert {"val/psnr_standard_error", "memory/resident_gigabytes"} <= set(tags["scalars"])
    assert [event.step for event in log.Scalars("Training loss/sum")] == [5, 10, 15, 20]
    assert {"Pictures/validation", "Pictures/cameras"} <= set(tags["images"])
    assert "config/text_summary" in tags["tensors"]
    started = log.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    settings = HParamsPluginData.FromString(started).session_start_info.hparams
    assert {"model", "scene", "seed", "trainer.max_steps"} <= set(settings)
    assert len(settings) <= 15
    assert "data.sample_budget" not in settings, "as by default"
    groups = sorted({tag.partition("/")[0] for kind in ("scalars", "images", "histograms") for tag in tags[kind]})
    assert groups[:3] == ["PSNR", "Pictures", "Training loss"]
    assert groups[-2:] == ["weights_along_rays", "weights_per_ray"]
    for level in ("coarse", "fine"):
        assert all(event.value > 0 for event in log.Scalars(f"gradients/norm_{level}"))
        assert [event.step for event in log.Scalars(f"rays/effective_samples_{level}")] == [10, 20]
        for name in ("weights_along_rays/weight", "weights_per_ray/effective_samples"):
            assert [event.step for event in log.Histograms(f"{name}_{level}")] == [10, 20], name
        shares = log.Histograms(f"weights_along_rays/weight_{level}")[-1].histogram_value
        assert 0 < sum(shares.bucket) <= 1.0 + 1e-5


def test_eval_needs_the_checkpoint_alone_and_repeats_the_trained_number(finished_run, nerf, tmp_path):
    result = nerf(
        "eval", f"ckpt={finished_run}/checkpoints/last.ckpt", f"paths.output_dir={tmp_path}", "evaluation.max_views=2"
    )
    assert result.code == 0, result.err
    ours = json.loads((tmp_path / "metrics.json").read_text())
    theirs = json.loads((finished_run / "metrics.json").read_text())
    assert ours["psnr"] == pytest.approx(theirs["psnr"], abs=1e-6)
    assert all(ours[part] == theirs[part] for part in ("protocol", "origin", "environment"))
    assert "test PSNR" in result.out


def test_a_loose_checkpoint_is_evaluated_beside_itself_on_another_split_and_in_bytes(finished_run, nerf, tmp_path):
    loose = tmp_path / "loose.ckpt"
    loose.write_bytes((finished_run / "checkpoints" / "best.ckpt").read_bytes())
    nerf("eval", f"ckpt={loose}", "evaluation.split=train", "evaluation.quantize=true", "evaluation.max_views=1")
    protocol = json.loads((tmp_path / "evaluation" / "metrics.json").read_text())["protocol"]
    assert (protocol["split"], protocol["pixels"]) == ("train", "8-bit")


def test_render_needs_nothing_but_the_file(finished_run, nerf, tmp_path):
    arguments = [f"ckpt={finished_run}/checkpoints/last.ckpt", "path=orbit", "path.num_frames=3", "path.width=21"]
    done(nerf("render", *arguments, f"paths.output_dir={tmp_path}"))
    _, frames = read_video(tmp_path / "video.mp4")
    assert frames.shape == (3, 22, 22, 3)  # 21 is odd: one pixel more, nothing rescaled
    arguments[0] = f"ckpt={finished_run}"  # the run folder will do
    done(nerf("render", *arguments, f"paths.output_dir={tmp_path}", "format=frames"))
    assert iio.imread(tmp_path / "video" / "frame_0002.png").shape == (21, 21, 3)


@pytest.mark.slow
def test_a_sweep_of_eval_keeps_the_scene_and_has_a_folder_per_job(finished_run, nerf, tmp_path):
    last = finished_run / "checkpoints" / "last.ckpt"
    done(nerf("eval", "-m", f"ckpt={last}", "evaluation.split=val,train", f"paths.output_dir={tmp_path}"))
    protocols = [json.loads(file.read_text())["protocol"] for file in sorted(tmp_path.glob("*/metrics.json"))]
    assert [protocol["split"] for protocol in protocols] == ["val", "train"]
    assert {protocol["scene"] for protocol in protocols} == {"npz"}


def test_a_model_can_start_from_another_runs_weights(finished_run, train, tmp_path):
    little = ("trainer.max_steps=1", "optimizer.lr=1e-12", "seed=7", "final.video=false")
    result = done(train(*little, f"init_from={finished_run}", "resume=auto"))
    assert f"starting from the weights of {finished_run}/checkpoints/last.ckpt, step " in result.err
    assert "resume=auto: there is no unfinished run with these settings to resume" in result.err
    ours = torch.load(tmp_path / "run/checkpoints/last.ckpt", weights_only=True)["state_dict"]
    theirs = torch.load(finished_run / "checkpoints/last.ckpt", weights_only=True)["state_dict"]
    assert all(torch.allclose(ours[key], theirs[key], atol=1e-9) for key in ours)


@pytest.mark.parametrize(
    ("has_transparency", "of", "said"),
    [(True, 2, "(2 views, white background)"), (False, 2, "(2 views)"), (False, 5, "(2 of 5 views)")],
)
def test_views_are_counted_and_a_background_named_where_one_can_be_seen(finished_run, has_transparency, of, said):
    metrics = json.loads((finished_run / "metrics.json").read_text())
    assert metrics["split_views"] == metrics["num_images"]
    metrics |= {"num_images": 2, "split_views": of, "lpips": 0.125}
    metrics["protocol"] |= {"background": "white", "lpips": "alex, version 0.1"}
    lines = metric_lines(metrics, finished_run, has_transparency)
    assert said in lines[0]
    assert "LPIPS        0.1250 (alex, version 0.1)" in lines


@pytest.mark.parametrize("experiment", ["lego_article", "lego_article_100", "lego_article_tpu"])
def test_the_article_trains_on_black_for_all_its_epochs(experiment):
    # What lego_article.yaml lists as different from the article is all that differs.
    config = composed("train", f"experiment={experiment}")
    assert (config.scene.cut_out, config.scene.background, config.trainer.max_steps) == (False, None, None)
    assert config.trainer.max_epochs == (300 if experiment == "lego_article" else 1000)


def test_the_articles_figure_is_drawn_after_each_epoch(train, tmp_path):
    article = ("callbacks=article", "data.batch_rays=512", "data.crop_steps=0", "callbacks.epoch_figures.every_steps=1")
    done(train(*article, "trainer.max_steps=9", "final.evaluate=false", "final.video=false"))
    figures = sorted(file.name for file in (tmp_path / "run/images/epochs").glob("*.png"))
    assert figures == ["epoch_0001.png", "epoch_0002.png"]  # 4 steps an epoch, 9 steps
