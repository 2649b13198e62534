"""What the monitor logs of the losses."""

import pytest
import torch
from support.configs import composed
from support.scenes import ball_scene
from support.steps import rays_of

from nerf_lightning.config.instantiate import build
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.evaluation.metrics import psnr
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.callbacks.monitor import level_scalars
from nerf_lightning.training.step import TrainStep


def test_the_loss_of_an_only_level_is_not_logged_twice():
    values = level_scalars(("fine",), torch.tensor([0.5]), torch.tensor([0.01]), ("fine",))
    assert values == {"train/loss": pytest.approx(0.5), "train/psnr_fine": pytest.approx(20.0)}


def test_several_levels_have_their_own_losses_beside_the_sum():
    values = level_scalars(("proposal", "fine"), torch.tensor([0.02, 0.01]), torch.tensor([0.3, 0.01]), ("fine",))
    assert values.keys() == {"train/loss", "train/loss_proposal", "train/loss_fine", "train/psnr_fine"}
    assert values["train/loss"] == pytest.approx(0.03)


class L1(Loss):
    def forward(self, renderings, target):
        errors = [((each.rgb - target.rgb).abs() * target.weight[..., None]).mean() for each in renderings]
        return {"absolute": torch.stack(errors)}


@pytest.mark.parametrize(
    ("model", "loss"),
    [("nerf_tiny", "mse"), ("nerf_tiny", "robust"), ("fast_proposal", "proposal"), ("nerf_tiny", "L1")],
)
def test_the_psnr_is_that_of_the_colours_whatever_the_loss_is(model, loss):
    small = ["encoder.num_levels=2", "encoder.log2_table_size=8", "field.width=16"] if "fast" in model else []
    config = composed("train", f"model={model}", *small, *([] if loss == "L1" else [f"loss={loss}"]))
    scene, progress = ball_scene(num_views=8, size=16), Progress()
    built = build(config.model)
    built.fit_to(scene)
    step = TrainStep(
        built, rays_of(scene), L1() if loss == "L1" else build(config.loss), lambda groups: torch.optim.Adam(groups),
        ExponentialDecay(), progress, 0, "white", 4096, num_steps=100,
    )  # fmt: skip
    if loss == "robust":
        step.loss.threshold.fill_(0.01)  # at first it leaves nothing out
    batch = RayBatches(scene, progress, 0, 128).at(0, 0)
    seen = step.gradients(batch)
    error = (seen.rgb - seen.target).square().mean()
    torch.testing.assert_close(psnr(seen.color_errors[-1]), psnr(error))
    if loss == "mse":
        torch.testing.assert_close(seen.color_errors, seen.losses, atol=0, rtol=0)
    else:
        assert not torch.isclose(seen.color_errors[-1], seen.losses[-1], rtol=1e-4)
