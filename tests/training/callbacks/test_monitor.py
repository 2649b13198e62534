"""What the monitor logs of the losses."""

import pytest
import torch

from nerf_lightning.training.callbacks.monitor import level_scalars


def test_the_loss_of_an_only_level_is_not_logged_twice():
    values = level_scalars(("fine",), torch.tensor([0.01]), ("fine",))
    assert values == {"train/loss": pytest.approx(0.01), "train/psnr_fine": pytest.approx(20.0)}


def test_several_levels_have_their_own_losses_beside_the_sum():
    values = level_scalars(("proposal", "fine"), torch.tensor([0.02, 0.01]), ("fine",))
    assert values.keys() == {"train/loss", "train/loss_proposal", "train/loss_fine", "train/psnr_fine"}
    assert values["train/loss"] == pytest.approx(0.03)
