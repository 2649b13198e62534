"""From states to colours: blended of what sources show, wherever they see anything."""

from dataclasses import replace

import pytest
import torch

from nerf_lightning.nerf.models.view_transformer.color import BlendedColor, PooledColor
from nerf_lightning.nerf.models.view_transformer.views import Views


def views(sources=4):
    torch.manual_seed(0)
    visible = torch.rand(3, 5, sources) < 0.6
    visible[:, 1] = False
    visible[:, 2] = True
    return torch.randn(3, 5, 16), Views(
        torch.randn(3, 5, sources, 16), torch.rand(3, 5, sources, 3), torch.randn(3, 5, sources, 4), visible
    )


def test_at_first_blended_colours_are_among_those_that_are_visible():
    states, seen = views()
    rgb, weights = BlendedColor(16)(states, seen, torch.zeros(3, 5))
    torch.testing.assert_close(weights.sum(dim=-1), torch.ones(3))
    assert torch.equal(weights[:, 1], torch.zeros(3))
    shown = seen.colors.masked_fill(~seen.visible[..., None], torch.inf).flatten(1, 2)
    assert (rgb >= shown.amin(dim=1)).all()
    shown = seen.colors.masked_fill(~seen.visible[..., None], -torch.inf).flatten(1, 2)
    assert (rgb <= shown.amax(dim=1)).all()


def test_one_colour_everywhere_is_the_colour_of_the_ray():
    states, seen = views()
    alike = replace(seen, colors=torch.tensor([0.2, 0.5, 0.9]).expand(seen.colors.shape))
    rgb, _ = BlendedColor(16)(states, alike, torch.zeros(3, 5))
    torch.testing.assert_close(rgb, torch.tensor([0.2, 0.5, 0.9]).expand(3, 3))


@pytest.mark.parametrize("kind", [PooledColor, BlendedColor])
def test_neither_the_order_of_sources_nor_what_is_masked_changes_anything(kind):
    states, seen = views()
    torch.manual_seed(1)
    color, weights = kind(16), torch.full((3, 5), 0.2)
    expected = color(states, seen, weights)[0]
    mixed = seen.map(lambda each: each[:, :, [2, 0, 3, 1]])
    torch.testing.assert_close(color(states, mixed, weights)[0], expected)
    hidden = ~seen.visible[..., None]
    other = Views(*(each.masked_fill(hidden, 50.0) for each in (seen.states, seen.colors, seen.turned)), seen.visible)
    torch.testing.assert_close(color(states, other, weights)[0], expected)


def test_where_no_source_sees_anything_gradients_are_finite():
    states, seen = views()
    seen.states.requires_grad_()
    nothing = replace(seen, visible=torch.zeros_like(seen.visible))
    color = BlendedColor(16)
    color(states.requires_grad_(), nothing, torch.zeros(3, 5))[0].sum().backward()
    assert all(each.grad.isfinite().all() for each in (states, seen.states, *color.parameters()))
