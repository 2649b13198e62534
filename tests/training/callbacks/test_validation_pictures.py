"""What is rendered while training is no larger than what is shown of it, and takes little of its time."""

from types import SimpleNamespace

import pytest
import torch
from support.scenes import ball_scene
from support.steps import make_step

from nerf_lightning.nerf.rendering.background import photograph
from nerf_lightning.training.callbacks import pictures, watcher


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
