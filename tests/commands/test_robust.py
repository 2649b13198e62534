"""`loss=robust`: which loss it weighs, and that its checkpoints are used without it."""

import pytest
from support.configs import composed
from support.running import FAST, done

from nerf_lightning.config.instantiate import build
from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.nerf.losses.proposal import ProposalLoss
from nerf_lightning.nerf.losses.robust import RobustLoss


@pytest.mark.parametrize(
    ("model", "of"), [("nerf", MeanSquaredError), ("fast", MeanSquaredError), ("fast_proposal", ProposalLoss)]
)
def test_it_weighs_the_loss_of_each_model(model, of):
    loss = build(composed("train", f"model={model}", "loss=robust").loss)
    assert isinstance(loss, RobustLoss)
    assert type(loss.of) is of


def test_its_checkpoint_is_used_without_it(nerf, train, capture, tmp_path):
    done(train("loss=robust", "loss.patch=4", "final.evaluate=false", "final.video=false"))
    last = tmp_path / "run" / "checkpoints" / "last.ckpt"
    done(nerf("eval", f"ckpt={last}", "evaluation.max_views=1", f"paths.output_dir={tmp_path / 'eval'}"))
    plain = ("train", "scene=npz", f"scene.path={capture}", *FAST, "final.evaluate=false", "final.video=false")
    done(nerf(*plain, f"init_from={last}", "trainer.max_steps=2", f"paths.output_dir={tmp_path / 'new'}"))
