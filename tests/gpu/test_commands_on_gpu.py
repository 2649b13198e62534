"""The commands on the GPU, each in a process of its own: train, resume, evaluate, render, export, view, self-test."""

import json

import pytest
import torch
from support.running import FAST, FAST_PATH, start

pytestmark = [pytest.mark.gpu, pytest.mark.slow]
QUIET = (*[x for x in FAST if not x.startswith(("model=", "data.batch", "data.crop"))], *FAST_PATH)
STEPS = 40
SETTINGS = {
    "fast_small": QUIET,
    "nerf_tiny": FAST,
    "fast_proposal": (*FAST[1:], "model=fast_proposal", "data.crop_steps=0"),
}


def finished(process, code=0):
    output, _ = process.communicate(timeout=500)
    assert process.returncode == code, output
    return output


def train(ball, trainer, folder, *extra, model="fast_small"):
    return start(
        "train", "scene=npz", f"scene.path={ball}", *SETTINGS[model], trainer, f"trainer.max_steps={STEPS}",
        "scheduler=constant", "final.video=false", f"paths.output_dir={folder}", *extra,
    )  # fmt: skip


def psnr(folder):
    return json.loads((folder / "metrics.json").read_text())["psnr"]


@pytest.fixture(scope="module")
def trained(ball, tmp_path_factory):
    """A finished run, made by the first test that asks."""
    folder = tmp_path_factory.mktemp("trained") / "run"

    def made(trainer):
        if not folder.exists():
            finished(train(ball, trainer, folder, "final.video=true"))
        return folder / "checkpoints" / "last.ckpt"

    return made


@pytest.mark.parametrize("model", SETTINGS)
@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed", "tf32"])
def test_a_run_from_beginning_to_end(model, precision, ball, trainer, device, tmp_path):
    if device.type == "cpu" and precision == "tf32":
        pytest.skip("only NVIDIA GPUs multiply in tf32")
    settings = (f"trainer.precision={precision}", "final.video=true", "trainer.tile_points=auto")
    output = finished(train(ball, trainer, tmp_path / "run", *settings, model=model))
    assert ("cuda" if device.type == "cuda" else "cpu") in output
    assert precision in output
    assert psnr(tmp_path / "run") > 8
    assert (tmp_path / "run" / "video.mp4").stat().st_size > 500


def test_what_is_trained_here_is_what_the_cpu_trains(ball, trainer, tmp_path):
    for name, override in (("here", trainer), ("cpu", "trainer=cpu")):
        finished(train(ball, override, tmp_path / name, "trainer.precision=32-true"))
    # A training goes another way from rounding on; another seed moves it by half a decibel.
    assert abs(psnr(tmp_path / "here") - psnr(tmp_path / "cpu")) < 0.5


def test_replayed_steps_train(ball, trainer, cuda, tmp_path):
    finished(train(ball, trainer, tmp_path / "run", "trainer.cuda_graph=true"))
    assert psnr(tmp_path / "run") > 8


def test_compiled_fields_train(ball, trainer, cuda, tmp_path):
    output = finished(train(ball, trainer, tmp_path / "run", "trainer.compile=true", model="nerf_tiny"))
    assert "compiled levels: coarse, fine" in output


@pytest.mark.parametrize("budget", [0, "auto"])
def test_pixels_train_from_the_host_and_from_the_device(budget, ball, trainer, tmp_path):
    finished(train(ball, trainer, tmp_path / "run", f"data.device_budget={budget}", "data.prefetch=auto"))
    assert psnr(tmp_path / "run") > 8


def test_a_run_that_is_stopped_goes_on_where_it_was(ball, trainer, device, tmp_path):
    settings = ("trainer.precision=32-true", "final.evaluate=false")
    finished(train(ball, trainer, tmp_path / "whole", *settings))
    finished(train(ball, trainer, tmp_path / "run", *settings, f"trainer.max_steps={STEPS // 2}"))
    output = finished(start("train", f"resume={tmp_path / 'run'}", f"trainer.max_steps={STEPS}", trainer))
    assert f"resuming from step {STEPS // 2}" in output
    states = [torch.load(tmp_path / name / "checkpoints/last.ckpt", weights_only=True) for name in ("run", "whole")]
    assert states[0]["nerf_lightning"]["progress"] == states[1]["nerf_lightning"]["progress"]
    name = "model.levels.fine.field.position_encoder.table"
    ours, theirs = (state["state_dict"][name] for state in states)
    # GPUs add in any order, and Adam makes whole steps (0.02) of rounding where gradients are all but zero.
    assert float(((ours - theirs).abs() > 0.02).double().mean()) <= (0.1 if device.type == "cuda" else 0.0)


def test_a_checkpoint_of_the_gpu_is_read_on_the_cpu_and_scores_the_same(trained, trainer, ball, tmp_path):
    checkpoint, scores = trained(trainer), []
    for override in (trainer, "trainer=cpu"):
        folder = tmp_path / override.replace("=", "_")
        finished(
            start("eval", f"ckpt={checkpoint}", override, "trainer.precision=32-true", f"paths.output_dir={folder}")
        )
        scores.append(psnr(folder))
    assert scores[0] == pytest.approx(scores[1], abs=0.01)


PATH = ("path=orbit", "path.num_frames=2", "path.width=32", "format=frames")


@pytest.mark.parametrize(
    "command",
    [
        ("render", *PATH, "outputs=[rgb,depth,opacity,normals]"),
        ("export", "what=cameras"),
        ("export", "what=images"),
        ("export", "what=points", "what.num_points=1000", "min_opacity=0.3", "what.agreement=0"),
        ("export", "what=volume", "what.resolution=16"),
    ],
)
def test_what_is_made_of_a_checkpoint(command, trained, trainer, tmp_path):
    name, *settings = command
    finished(start(name, f"ckpt={trained(trainer)}", *settings, trainer, f"paths.output_dir={tmp_path}"))
    assert any(file.stat().st_size for file in tmp_path.rglob("*") if file.is_file())


def test_two_runs_share_one_gpu(ball, trainer, tmp_path):
    runs = [train(ball, trainer, tmp_path / str(number), "trainer.precision=32-true") for number in range(2)]
    for run in runs:
        finished(run)
    assert psnr(tmp_path / "0") == pytest.approx(psnr(tmp_path / "1"), abs=0.5)


def test_more_processes_than_gpus_are_refused_by_number(ball, trainer, cuda, tmp_path):
    there = torch.cuda.device_count()
    output = finished(train(ball, trainer, tmp_path / "run", f"trainer.devices={there + 1}"), code=2)
    assert f"there are {there} devices here" in output


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_two_gpus_follow_one(ball, cuda, tmp_path):
    for name, override in (("one", "trainer=gpu"), ("two", "trainer=ddp")):
        finished(train(ball, override, tmp_path / name, "trainer.precision=32-true"))
    assert psnr(tmp_path / "two") == pytest.approx(psnr(tmp_path / "one"), abs=0.5)


def test_the_self_test_says_that_all_is_right(trainer, tmp_path):
    output = finished(start("selftest", trainer, f"paths.output_dir={tmp_path}"))
    assert " 0 wrong, " in output
    assert json.loads((tmp_path / "selftest.json").read_text())["right"]
