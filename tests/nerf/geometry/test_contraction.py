"""Space that has no end: its contraction, the spacing that goes with it, and the switch that a scene turns."""

from dataclasses import replace

import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.nerf.geometry.contraction import Contracted, contract, from_normalized_distance, normalized_distance


def test_contraction_keeps_the_unit_ball_and_brings_infinity_to_two():
    points = torch.nn.functional.normalize(torch.randn(50, 3), dim=-1)
    torch.testing.assert_close(contract(0.7 * points), 0.7 * points)
    torch.testing.assert_close(contract(1e9 * points).norm(dim=-1), torch.full((50,), 2.0))
    radius = torch.logspace(-2, 4, 200)[:, None] * torch.tensor([[0.6, 0.8, 0.0]])
    assert bool((contract(radius).norm(dim=-1).diff() >= 0).all())


def test_the_two_are_inverse():
    distances = torch.cat([torch.linspace(0, 3, 100), torch.tensor([10.0, 100.0, 1e4])]).double()
    assert torch.allclose(from_normalized_distance(normalized_distance(distances)), distances, rtol=1e-9)
    shares = torch.linspace(0, 0.9999, 100).double()
    assert torch.allclose(normalized_distance(from_normalized_distance(shares)), shares, atol=1e-12)


def test_it_grows_from_nothing_to_one_and_ends_finite():
    distances = torch.logspace(-3, 6, 1000).double()
    assert bool((normalized_distance(distances).diff() > 0).all())
    assert float(normalized_distance(torch.tensor(0.0))) == 0.0
    assert bool(torch.isfinite(from_normalized_distance(torch.tensor([1.0, 0.5, 0.0]))).all())


def test_from_the_middle_even_steps_are_even_steps_of_the_contraction():
    distances = from_normalized_distance(torch.linspace(0.0, 0.999, 200, dtype=torch.float64))
    along = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    steps = contract(distances[:, None] * along).norm(dim=-1).diff()
    assert torch.allclose(steps, steps.mean().expand_as(steps), rtol=1e-9)


def test_the_config_overrules_the_scene():
    for fixed, space, result in (
        (None, "bounded", False), (None, "ndc", False), (None, "contracted", True), (True, "bounded", True),
        (False, "contracted", False),
    ):  # fmt: skip
        switch = Contracted(fixed)
        for another in ("contracted", "bounded", space):  # a second scene turns it again
            switch.fit_to(replace(ball_scene(), space=another))
        assert switch.is_on() is result


@pytest.mark.parametrize("state", [True, False])
def test_it_travels_in_the_state_dict(state):
    one, other = Contracted(), Contracted()
    one.switch.fill_(state)
    assert not other.is_on()
    other.load_state_dict(one.state_dict())
    assert other.is_on() is state
