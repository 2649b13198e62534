"""What a model sees of photographs: those it is given, by capture, and how their cameras stand."""

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.photographs import photographs_of


def test_they_are_the_views_that_were_asked_for():
    scene = replace(ball_scene(), capture_of=(0, 0, 0, 1, 1, 1), captures=("left", "right"))
    seen = photographs_of(scene, [4, 1, 3])
    assert seen.numbers.tolist() == [4, 1, 3]
    assert seen.capture.tolist() == [1, 0, 1]
    for place, number in enumerate([4, 1, 3]):
        assert torch.equal(seen.pixels.view(place), scene.pixels.view(number))
        assert torch.equal(seen.cameras.c2w[place], scene.cameras.c2w[number])


def test_cameras_stand_around_or_face_forward():
    scene = ball_scene()
    around = photographs_of(scene, range(6))
    assert around.around.tolist() == [True]
    torch.testing.assert_close(around.middle, torch.zeros(1, 3), atol=1e-4, rtol=0)
    eyes = scene.cameras.c2w.clone()
    eyes[:, :, :3] = eyes[:1, :, :3]
    ahead = photographs_of(replace(scene, cameras=replace(scene.cameras, c2w=eyes)), range(6))
    assert ahead.around.tolist() == [False]


def test_normalised_device_coordinates_are_refused():
    scene = ball_scene()
    bent = replace(scene, cameras=replace(scene.cameras, ndc=torch.ones(6, 2)))
    with pytest.raises(InputError, match=r"scene\.space=contracted"):
        photographs_of(bent, [0, 1])
