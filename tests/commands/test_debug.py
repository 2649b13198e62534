"""debug=fast, overfit and profile, and print_config: what one looks at before a long training."""

import re

import pytest
from support.captures import write_npz
from support.configs import composed
from support.running import refused

import nerf_lightning as nl
from nerf_lightning.nerf.randomness import PointRandom

SMALL = ("model=nerf_tiny", "data.batch_rays=32", "data.val_rays=32", "trainer=cpu", "trainer.tile_points=8192")


@pytest.fixture
def train(tmp_path):
    capture = write_npz(tmp_path / "capture.npz")

    def call(*overrides):
        place = ("scene=npz", f"scene.path={capture}", f"paths.output_dir={tmp_path / 'run'}")
        return nl.train(*place, *SMALL, *overrides)

    return call


def test_fast_does_everything_once(train):
    run = train("debug=fast", "path.width=8")
    left = {path.relative_to(run.folder).as_posix() for path in run.folder.rglob("*") if path.is_file()}
    assert {
        *("checkpoints/last.ckpt", "checkpoints/best.ckpt", "metrics.json", "video.mp4", "depth.mp4"),
        *("images/validation/step_0000002.png", "images/validation/step_0000004.png"),
    } <= left
    assert run.model.checkpoint.step == 4
    assert len(run.metrics["per_image"]) == 1


def test_overfit_learns_few_photographs_without_a_random_number(train, monkeypatch):
    def drawn(numbers, purpose):
        raise AssertionError(f"a number was drawn for {purpose}")

    monkeypatch.setattr(PointRandom, "uniform", drawn)
    few = composed("train", *SMALL, "debug=overfit").data
    assert (few.overfit_views, few.crop_steps) == (4, 0)
    run = train("debug=overfit", "trainer.max_steps=3", "data.overfit_views=2", "trainer.val_every_steps=1")
    assert run.psnr > 0
    splits = run.model.scene.splits
    made = nl.build_run("scene=npz", f"scene.path={run.folder.parent / 'capture.npz'}", *SMALL, "data.overfit_views=2")
    assert set(made.data.batches.batch_at(0, 0).pixels.view.tolist()) <= set(splits["train"])
    assert made.data.scene.splits["train"] == made.data.scene.splits["val"] != splits["val"]
    assert len(made.data.scene.splits["train"]) == 2
    refused(train, "data.overfit_views=0", parts=("data.overfit_views=0", "at least one"))


def test_the_config_is_printed_and_profile_ends_with_a_table(train, capsys):
    run = train("print_config=true", "debug=profile", "trainer.max_steps=3", "logger=none")
    out = capsys.readouterr().out
    assert "_target_: nerf_lightning.nerf.models.radiance_model.RadianceModel\n" in out
    assert re.search(r"^  batch_rays: 32$", out, re.MULTILINE)
    assert "${" not in out
    table = out.splitlines()
    start = next(number for number, line in enumerate(table) if line.startswith("action"))
    seconds = [float(line.split()[-1]) for line in table[start + 1 : start + 6]]
    assert seconds == sorted(seconds, reverse=True)
    assert all(len(line) <= 100 for line in table[start : start + 16])
    assert (run.folder / "fit-profile.txt").is_file()
