"""What the monitor logs of the losses, and histograms of what lies along rays."""

import copy
from types import SimpleNamespace

import pytest
import torch
from support.configs import composed
from support.scenes import ball_scene, tiny_model
from support.static_models import fast_model, static_system
from support.steps import make_step, rays_of

from nerf_lightning.config.instantiate import build
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.losses.base import Loss
from nerf_lightning.nerf.models.ragged_level import RaggedLevel
from nerf_lightning.nerf.objective import Objective
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.part import fit_parts
from nerf_lightning.nerf.psnr import psnr
from nerf_lightning.nerf.rendering.background import photograph
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.training.attempts import draw_weights
from nerf_lightning.training.callbacks import pictures, watcher
from nerf_lightning.training.callbacks.monitor import level_scalars
from nerf_lightning.training.callbacks.ray_histograms import look_along
from nerf_lightning.training.step import TrainStep


def test_losses_of_levels_stand_beside_their_sum_unless_there_is_one_alone():
    values = level_scalars(("fine",), torch.tensor([0.5]), torch.tensor([0.01]), ("fine",))
    assert values == {"train/loss": pytest.approx(0.5), "train/psnr_fine": pytest.approx(20.0)}
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
    fit_parts(built, scene)
    train_step = TrainStep(
        Objective(built, rays_of(scene), L1() if loss == "L1" else build(config.loss), "white"),
        lambda groups: torch.optim.Adam(groups), ExponentialDecay(), progress, 0, 4096, num_steps=100,
    )  # fmt: skip
    draw_weights(train_step)
    if loss == "robust":
        train_step.objective.loss.threshold.fill_(0.01)  # at first it leaves nothing out
    batch = RayBatches(scene, progress, 0, 128).batch_at(0, 0)
    seen = train_step.gradients(batch, train_step.key)
    error = (seen.rgb - seen.target).square().mean()
    torch.testing.assert_close(psnr(seen.color_errors[-1]), psnr(error))
    if loss == "mse":
        torch.testing.assert_close(seen.color_errors, seen.losses, atol=0, rtol=0)
    else:
        assert not torch.isclose(seen.color_errors[-1], seen.losses[-1], rtol=1e-4)


def a_system(name):
    progress, scene = Progress(), ball_scene(num_views=6)
    model = fast_model(RaggedLevel) if name == "fast_dense" else tiny_model()
    system = static_system(name, scene, progress, 10, model=model)
    return system.train_step, RayBatches(scene, progress, 0, 64).batch_at(0, 0)


@pytest.mark.parametrize("name", ["nerf", "fast_dense"])
def test_looking_changes_nothing_that_training_reads(name):
    train_step, batch = a_system(name)
    train_step.gradients(batch, train_step.key)
    before = copy.deepcopy(train_step.objective.model.state_dict())
    gradients = [parameter.grad.clone() for parameter in train_step.objective.model.parameters()]
    generator = torch.get_rng_state()
    look_along(train_step, batch.pixels, 7, contracted_spacing=False)
    assert train_step.objective.model.training
    for key, value in train_step.objective.model.state_dict().items():
        assert torch.equal(value, before[key]), key
    for parameter, gradient in zip(train_step.objective.model.parameters(), gradients, strict=True):
        assert torch.equal(parameter.grad, gradient)
    assert torch.equal(torch.get_rng_state(), generator)


def a_run(scene, train_step, folder):
    model, rays = train_step.objective.model, train_step.objective.rays
    system = SimpleNamespace(model=model, rays=rays, train_step=train_step, eval=model.eval, train=model.train)
    trainer = SimpleNamespace(
        is_global_zero=True, global_step=7, loggers=[], default_root_dir=folder, datamodule=SimpleNamespace(scene=scene)
    )
    return trainer, system


def test_a_small_validation_picture_is_compared_with_the_means_of_its_photograph(tmp_path, monkeypatch):
    scene, step, shown = ball_scene(), make_step(None), []
    view = scene.splits["val"][1]
    side = int(scene.cameras.width[view]) // 2
    monkeypatch.setattr(watcher, "LONGEST_PANEL", side)
    monkeypatch.setattr(pictures, "panels", lambda *given: shown.append(given) or [])
    monkeypatch.setattr(pictures, "mosaic", lambda panels: torch.zeros(2, 2, 3, dtype=torch.uint8))
    pictures.ValidationPictures(view=1).watch(*a_run(scene, step, tmp_path), None)
    ((truth, rendered, *_),) = shown
    whole = photograph(scene, view, scene.background)
    squares = whole.unflatten(0, (side, 2)).unflatten(2, (side, 2)).mean(dim=(1, 3))
    torch.testing.assert_close(truth, squares)
    assert rendered.shape == truth.shape
    assert (tmp_path / "images" / "progress" / "step_0000007.png").is_file()


@pytest.mark.parametrize("every_steps", ["auto", 1000])
def test_pictures_take_at_most_a_twentieth_of_the_time_unless_their_number_was_typed(
    every_steps, tmp_path, monkeypatch
):
    now = [100.0]

    def slowly(trainer, system, number):
        now[0] += 2.0
        return watcher.render_validation_view(trainer, system, number)

    monkeypatch.setattr(pictures.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(pictures, "render_validation_view", slowly)
    taken = pictures.ValidationPictures(every_steps)
    assert taken.is_time(1000, 10_000)
    taken.watch(*a_run(ball_scene(), make_step(None), tmp_path), None)
    assert taken.is_time(2000, 10_000) == (every_steps == 1000)
    assert taken.is_time(10_000, 10_000)
    now[0] += 38.0
    assert taken.is_time(3000, 10_000)
    assert not taken.is_time(3001, 10_000)
