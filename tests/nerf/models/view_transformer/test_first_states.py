"""What states begin with: of the views that see the point, in any order."""

from dataclasses import replace

import pytest
import torch

from nerf_lightning.nerf.models.view_transformer.start import Largest, Spread, moments
from nerf_lightning.nerf.models.view_transformer.views import Views


def views():
    torch.manual_seed(0)
    visible = torch.rand(3, 5, 4) < 0.6
    visible[:, 1], visible[:, 2] = False, True
    return Views(torch.randn(3, 5, 4, 16), torch.rand(3, 5, 4, 3), torch.randn(3, 5, 4, 4), visible)


def test_the_largest_is_that_of_the_views_that_see_the_point():
    seen, found = views(), Largest(16)(views())
    assert torch.equal(found[:, 1], torch.zeros(3, 16))
    assert torch.equal(found[:, 2], seen.states[:, 2].amax(dim=1))
    (which,) = seen.visible[0, 0].nonzero().T
    assert torch.equal(found[0, 0], seen.states[0, 0, which].amax(dim=0))


def test_moments_are_mean_and_variance():
    seen = views()
    share = seen.visible / seen.visible.sum(dim=-1, keepdim=True).clamp(min=1)
    mean, variance = moments(seen.colors, share)
    for ray, sample in ((0, 0), (1, 2), (2, 4)):
        of_point = seen.colors[ray, sample, seen.visible[ray, sample]]
        torch.testing.assert_close(mean[ray, sample], of_point.mean(dim=0))
        torch.testing.assert_close(variance[ray, sample], of_point.var(dim=0, correction=0))
    assert torch.equal(variance[:, 1], torch.zeros(3, 3))


@pytest.mark.parametrize("kind", [Largest, Spread])
def test_neither_the_order_of_sources_nor_what_is_masked_changes_anything(kind):
    torch.manual_seed(1)
    start, seen = kind(16), views()
    torch.testing.assert_close(start(seen.map(lambda each: each[:, :, [2, 0, 3, 1]])), start(seen))
    hidden = ~seen.visible[..., None]
    other = replace(seen, states=seen.states.masked_fill(hidden, 50.0), colors=seen.colors.masked_fill(hidden, 9.0))
    torch.testing.assert_close(start(other), start(seen))


def test_where_no_view_sees_the_point_gradients_are_finite():
    torch.manual_seed(1)
    start, seen = Spread(16), views()
    states, colors = seen.states.requires_grad_(), seen.colors.requires_grad_()  # learnt cameras move colours
    start(replace(seen, visible=torch.zeros_like(seen.visible))).sum().backward()
    assert all(each.grad is None or each.grad.isfinite().all() for each in (states, colors, *start.parameters()))
