"""`loss=robust` through the command line: what it learns is part of a run, and of its checkpoints."""

import pytest
from support.configs import composed
from support.running import FAST, done, said

from nerf_lightning.config.instantiate import build
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.losses.proposal import ProposalLoss
from nerf_lightning.nerf.losses.robust import RobustLoss


def arguments(capture, folder, *more):
    return (
        "train", "scene=npz", f"scene.path={capture}", *FAST, "loss=robust", "loss.patch=4", "final.evaluate=false",
        "final.video=false", f"paths.output_dir={folder}", *more,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("model", "of"), [("nerf", MeanSquaredError), ("fast", MeanSquaredError), ("fast_proposal", ProposalLoss)]
)
def test_it_weighs_the_loss_of_each_model(model, of):
    loss = build(composed("train", f"model={model}", "loss=robust").loss)
    assert isinstance(loss, RobustLoss)
    assert type(loss.of) is of


def test_its_checkpoint_is_used_without_it(nerf, capture, tmp_path):
    done(nerf(*arguments(capture, tmp_path / "run")))
    last = tmp_path / "run" / "checkpoints" / "last.ckpt"
    done(nerf("eval", f"ckpt={last}", "evaluation.max_views=1", f"paths.output_dir={tmp_path / 'eval'}"))
    plain = ("train", "scene=npz", f"scene.path={capture}", *FAST, "final.evaluate=false", "final.video=false")
    done(nerf(*plain, f"init_from={last}", "trainer.max_steps=2", f"paths.output_dir={tmp_path / 'new'}"))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["loss.patch=32", "data.batch_rays=1024"], "loss.patch=32 draws squares of 32 x 32 pixels"),
        (["data.batch_rays=40"], "data.batch_rays=40 is not a multiple of that. Give data.batch_rays=32"),
        (["loss.share=0"], "share=0: give 0.01 to 1.0"),
    ],
)
def test_bad_settings_are_one_paragraph(nerf, capture, tmp_path, settings, words):
    said(nerf(*arguments(capture, tmp_path / "run", *settings)), words)
    assert not (tmp_path / "run").exists()
