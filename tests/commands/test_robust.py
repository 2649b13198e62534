"""`loss=robust`: which loss it weighs, and that its checkpoints are used without it."""

import pytest
from support.configs import composed

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
