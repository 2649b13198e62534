"""What a training chooses where the user leaves it open, and says."""

from dataclasses import replace

import pytest
from support.scenes import ball_scene

from nerf_lightning.config.compose import compose_config
from nerf_lightning.errors import InputError
from nerf_lightning.training.auto_settings import settled

IN_A_BOX = ball_scene()
PHOTOGRAPHS = replace(IN_A_BOX, space="contracted")
FORWARD_FACING = replace(IN_A_BOX, space="ndc")


def chosen_for(scene, *overrides):
    config, choices = compose_config("train", overrides)
    return settled(config, choices, overrides, scene)


@pytest.mark.parametrize(
    ("scene", "model", "batch_rays"),
    [(IN_A_BOX, "fast", 8192), (PHOTOGRAPHS, "fast_proposal", 1024), (FORWARD_FACING, "fast_proposal", 1024)],
)
def test_the_model_follows_the_scene_and_is_said(caplog, scene, model, batch_rays):
    caplog.set_level("INFO")
    config, choices = chosen_for(scene, "seed=3")
    assert choices["model"] == model
    assert (config.data.batch_rays, config.seed) == (batch_rays, 3)
    assert f"model: {model}, since " in caplog.text
    assert "(model=NAME chooses another)" in caplog.text


@pytest.mark.parametrize("named", ["model=nerf", "experiment=fern"])
def test_a_model_that_is_named_stays(caplog, named):
    caplog.set_level("INFO")
    _, choices = chosen_for(PHOTOGRAPHS, named)
    assert choices["model"] == "nerf"
    assert "model:" not in caplog.text


def test_settings_of_the_user_hold_in_the_model_that_is_chosen():
    config, _ = chosen_for(PHOTOGRAPHS, "data.batch_rays=512", "encoder.log2_table_size=12")
    assert config.data.batch_rays == 512
    assert config.encoder.log2_table_size == 12


def test_photographs_alone_are_examined_trained_for_minutes_and_reported():
    photos, _ = chosen_for(PHOTOGRAPHS, "scene=photos", "scene.root=a")
    assert (photos.doctor, photos.final.report, photos.budget.seconds) == (True, True, 300)
    other, _ = chosen_for(PHOTOGRAPHS, "scene=colmap", "scene.root=a")
    assert (other.doctor, other.final.report, other.budget.seconds) == (False, False, None)
    given, _ = chosen_for(PHOTOGRAPHS, "scene=photos", "doctor=off", "final.report=false", "budget.seconds=60")
    assert (given.doctor, given.final.report, given.budget.seconds) == (False, False, 60)
    endless, _ = chosen_for(PHOTOGRAPHS, "scene=photos", "budget.seconds=null")
    assert endless.budget.seconds is None


def test_what_is_neither_a_switch_nor_auto_is_refused():
    with pytest.raises(InputError, match="doctor=maybe does not fit"):
        chosen_for(PHOTOGRAPHS, "doctor=maybe")
