import pytest
import torch

from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.rendering.blending import background_colors, blend
from nerf_lightning.nerf.types.scene import UNSURE

CPU = torch.device("cpu")


def test_alpha_is_composited_exactly_once():
    """The faults: alpha never applied (red stays red) or applied twice (a quarter becomes a sixteenth)."""
    red = torch.tensor([1.0, 0.0, 0.0, 0.25])
    torch.testing.assert_close(blend(red, torch.ones(3)), torch.tensor([1.0, 0.75, 0.75]))
    torch.testing.assert_close(blend(red, torch.zeros(3)), torch.tensor([0.25, 0.0, 0.0]))


def test_without_a_background_colours_are_taken_as_they_are():
    rgba = torch.rand(5, 4)
    assert torch.equal(blend(rgba, None), rgba[:, :3])


@pytest.mark.parametrize(("name", "value"), [("white", 1.0), ("black", 0.0)])
def test_plain_backgrounds(name, value):
    assert torch.equal(background_colors(name, 3, CPU, None), torch.full((3, 3), value))


def test_a_random_background_is_fresh_per_ray_and_white_at_evaluation():
    colours = background_colors("random", 500, CPU, batch_random(3, 500))
    assert colours.unique(dim=0).shape[0] == 500
    assert abs(float(colours.mean()) - 0.5) < 0.05
    assert torch.equal(background_colors("random", 2, CPU, None), torch.ones(2, 3))


@pytest.mark.parametrize(("name", "value"), [("white_or_random", 1.0), ("black_or_random", 0.0)])
def test_pixels_that_may_show_what_was_cut_out_keep_its_colour_behind_them(name, value):
    rgba, random = torch.rand(4, 4), batch_random(3, 4)
    rgba[:, 3] = torch.tensor([0, UNSURE - 1, UNSURE, 255]) / 255
    colours, drawn = background_colors(name, 4, CPU, random, rgba), background_colors("random", 4, CPU, random, rgba)
    assert (colours[2] == value).all()
    assert torch.equal(colours[[0, 1, 3]], drawn[[0, 1, 3]])
    assert torch.equal(background_colors(name, 4, CPU, None, rgba), torch.full((4, 3), value))


def test_none_closes_the_ray():
    assert background_colors("none", 3, CPU, batch_random(0, 3)) is None
