import pytest
import torch
from lightning.pytorch.trainer.states import TrainerFn, TrainerState
from support.scenes import ball_scene
from support.steps import make_step

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.messages.errors import InputError
from nerf_lightning.training.system import RadianceFieldSystem


def test_weights_that_are_not_finite_are_not_saved():
    system = RadianceFieldSystem(make_step(None), {})
    system._trainer = type("T", (), {"global_step": 7, "default_root_dir": "outputs/x"})()
    with torch.no_grad():
        system.model.levels["fine"].field.color_head.bias[0] = float("inf")
    with pytest.raises(InputError, match=r"weights of step 7 are not finite.*optimizer\.lr"):
        system.on_save_checkpoint({})


def test_validation_has_no_jitter():
    system = RadianceFieldSystem(make_step(None), {})
    logged = {}
    logger = type("L", (), {"log_metrics": staticmethod(lambda values, step: logged.update(values))})()
    fits = {"state": TrainerState(fn=TrainerFn.FITTING), "loggers": [logger], "global_step": 3}
    system._trainer = type("T", (), {"sanity_checking": False} | fits)()
    system.log_dict = lambda values, **options: None
    loader = RayBatches(ball_scene(), system.step.progress, 0, 64)
    values = []
    for _ in range(2):
        with torch.no_grad():
            system.validation_step(loader.at(0, 0), 0)
            system.on_validation_epoch_end()
        values.append(dict(logged))
    assert values[0] == values[1]
    assert values[0]["val/psnr_standard_error"] > 0
