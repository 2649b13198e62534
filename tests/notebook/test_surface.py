"""What `import nerf_lightning as nl` offers: read, load and render, train."""

import signal

import pytest
import torch
from hydra.core.hydra_config import HydraConfig
from support.captures import write_blender, write_npz
from support.running import FAST, refused

import nerf_lightning as nl
from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.training.callbacks.stop_signals import StopSignals

SMALL = (*FAST, "trainer=cpu", "final.video=false", "callbacks=default")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_npz(tmp_path_factory.mktemp("capture") / "capture.npz")


@pytest.fixture(scope="module")
def run(capture, tmp_path_factory):
    folder, theirs = tmp_path_factory.mktemp("runs") / "run", HydraConfig.instance().cfg
    trained = nl.train("scene=npz", f"scene.path={capture}", f"paths.output_dir={folder}", *SMALL)
    assert HydraConfig.instance().cfg is theirs
    return trained


def test_a_folder_is_read_as_its_files_tell_or_as_it_is_named_and_so_is_an_archive(tmp_path, capture):
    folder = write_blender(tmp_path, {"train": 3, "val": 1, "test": 1})
    scene = nl.read(folder, background="black")
    assert isinstance(scene, nl.Scene)
    assert scene.background == "black"
    assert scene.pixels.view(0).shape == (8, 8, 4)
    assert scene.cameras.c2w.shape == (5, 3, 4)
    assert len(nl.read(folder, scene="blender").splits["train"]) == 3
    assert len(nl.read(capture).view_names) == 10


@pytest.mark.parametrize(
    ("settings", "parts"),
    [
        ({"capture": "nowhere"}, ("nowhere",)),
        ({"scene": "blendr"}, ("blendr", "blender")),
        ({"scene": "bricks", "resolutoin": 8}, ("resolutoin", "resolution")),
        ({"scene": "bricks", "resolution": "high"}, ("scene.resolution=high", "whole number")),
    ],
)
def test_what_cannot_be_read_is_told_in_words(settings, parts):
    refused(lambda: nl.read(**settings), parts=parts)


def test_a_run_leaves_folder_metrics_and_the_model_of_its_checkpoint(run):
    assert (run.folder / "run.json").is_file()
    assert run.metrics["psnr"] == run.psnr
    assert len(run.metrics["per_image"]) == 2
    assert run.model.checkpoint.step == 4
    one, other = nl.load(run.folder, "trainer=cpu"), nl.load(run.folder / "checkpoints" / "last.ckpt", "trainer=cpu")
    assert torch.equal(one.render(0).rgb, other.render(0).rgb)
    assert not one.module.training


def test_a_view_is_rendered_by_number_name_and_camera_and_a_path_camera_by_camera(run, capture):
    model, scene = run.model, nl.read(capture)
    picture = model.render(2)
    assert isinstance(picture, nl.Picture)
    assert (picture.rgb.shape, picture.depth.shape, picture.opacity.shape) == ((4, 6, 3), (4, 6), (4, 6))
    assert torch.equal(model.render(model.scene.view_names[2]).rgb, picture.rgb)
    assert torch.equal(model.render(-8).rgb, picture.rgb)
    seen = model.render(scene.user_cameras[2])
    torch.testing.assert_close(seen.rgb, picture.rgb, rtol=0, atol=1e-3)
    assert not torch.equal(model.render(2, background="black").rgb, model.render(2, background="white").rgb)
    cameras = run.model.path("orbit", num_frames=3, width=5, height=4)
    assert run.model.render(cameras[1]).depth.shape == (4, 5)
    assert run.model.render(cameras[1:2]).depth.shape == (4, 5)


def test_a_model_is_exported_as_by_the_command(run, tmp_path):
    assert run.model.export("cameras", tmp_path, images="photos")[0] == tmp_path / "transforms.json"
    assert '"file_path": "photos/' in (tmp_path / "transforms.json").read_text()
    assert run.model.export("cameras")[0].parent == run.folder / "export"


@pytest.mark.parametrize(
    ("ask", "parts"),
    [
        (lambda model: model.render(10), ("no view 10", "10, numbered from 0")),
        (lambda model: model.render("r_7"), ("'r_7'", "view_names")),
        (lambda model: model.render(model.scene.cameras), ("10 cameras", "cameras[0]")),
        (lambda model: model.render(0, background="blue"), ("blue",)),
        (lambda model: model.path("orbitt"), ("orbitt", "orbit")),
        (lambda model: model.path(num_frames=0), ("num_frames",)),
        (lambda model: model.export("pages"), ("pages", "page")),
        (lambda model: model.export("page", sh_degree=4), ("what.sh_degree=4",)),
        (lambda model: nl.load("nowhere"), ("no checkpoint",)),
    ],
)
def test_what_cannot_be_rendered_is_told_in_words(run, ask, parts):
    refused(ask, run.model, parts=parts)


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (["modle=fast"], ("modle", "model")),
        (["trainer.max_steps=-1"], ("trainer.max_steps=-1", "positive")),
        (["trainer.devices=2"], ("several", "nerf train", "nl.load")),
        (["-m", "seed=0,1"], ("-m",)),
        (["resume=nowhere"], ("nowhere",)),
        (["init_from=nowhere"], ("nowhere",)),
    ],
)
def test_what_makes_no_run_is_told_in_words_and_leaves_nothing(overrides, parts, capture, tmp_path):
    place = (f"paths.root_dir={tmp_path / 'runs'}", "scene=npz", f"scene.path={capture}", *SMALL)
    refused(nl.train, *place, *overrides, parts=parts)
    assert not (tmp_path / "runs").exists()


def test_a_run_that_is_stopped_saves_and_goes_on(capture, tmp_path, monkeypatch):
    settings = ("scene=npz", f"scene.path={capture}", f"paths.output_dir={tmp_path / 'run'}", *SMALL)
    begin = StopSignals.on_train_start

    def stop(callback, trainer, module):
        begin(callback, trainer, module)
        signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(StopSignals, "on_train_start", stop)
        with pytest.raises(KeyboardInterrupt):
            nl.train(*settings)
    assert read_checkpoint(tmp_path / "run").step < 4
    done = nl.train(*settings, "resume=auto", "final.evaluate=false")
    assert done.model.checkpoint.step == 4
    assert done.metrics == {}
