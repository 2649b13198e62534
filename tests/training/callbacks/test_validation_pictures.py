"""What is rendered while training is no larger than what is shown of it."""

from types import SimpleNamespace

import torch
from support.scenes import ball_scene
from support.steps import make_step

from nerf_lightning.nerf.rendering.blending import photograph
from nerf_lightning.training.callbacks import pictures, watcher


def test_a_small_validation_picture_is_compared_with_the_means_of_its_photograph(tmp_path, monkeypatch):
    scene, step, shown = ball_scene(), make_step(None), []
    view = scene.splits["val"][1]
    side = int(scene.cameras.width[view]) // 2
    monkeypatch.setattr(watcher, "LONGEST_PANEL", side)
    monkeypatch.setattr(pictures, "panels", lambda *given: shown.append(given) or [])
    monkeypatch.setattr(pictures, "mosaic", lambda panels: torch.zeros(2, 2, 3, dtype=torch.uint8))
    system = SimpleNamespace(model=step.model, rays=step.rays, step=step, eval=step.model.eval, train=step.model.train)
    trainer = SimpleNamespace(
        is_global_zero=True,
        global_step=7,
        loggers=[],
        default_root_dir=tmp_path,
        datamodule=SimpleNamespace(scene=scene),
    )
    pictures.ValidationPictures(view=1).watch(trainer, system, None)
    ((truth, rendered, *_),) = shown
    whole = photograph(scene, view, scene.background)
    squares = whole.unflatten(0, (side, 2)).unflatten(2, (side, 2)).mean(dim=(1, 3))
    torch.testing.assert_close(truth, squares)
    assert rendered.shape == truth.shape
    assert (tmp_path / "images" / "progress" / "step_0000007.png").is_file()
