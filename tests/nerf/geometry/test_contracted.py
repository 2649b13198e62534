"""The switch between a box and all of space: set by the scene, or by the config, and kept in checkpoints."""

from dataclasses import replace

import pytest
from support.scenes import ball_scene

from nerf_lightning.nerf.geometry.contraction import Contracted


@pytest.mark.parametrize(
    ("fixed", "space", "result"),
    [
        (None, "bounded", False),
        (None, "ndc", False),
        (None, "contracted", True),
        (True, "bounded", True),
        (False, "contracted", False),
    ],
)
def test_the_config_overrules_the_scene(fixed, space, result):
    switch = Contracted(fixed)
    switch.fit_to(replace(ball_scene(), space=space))
    assert switch.is_on() is result


def test_a_second_scene_turns_it_again():
    switch = Contracted()
    for space in ("contracted", "bounded", "contracted"):
        switch.fit_to(replace(ball_scene(), space=space))
        assert switch.is_on() == (space == "contracted")


@pytest.mark.parametrize("state", [True, False])
def test_it_travels_in_the_state_dict(state):
    one, other = Contracted(), Contracted()
    one.switch.fill_(state)
    assert not other.is_on()
    other.load_state_dict(one.state_dict())
    assert other.is_on() is state
