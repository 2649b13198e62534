"""Attention over the views of a point: a masked softmax, in whatever order the views come."""

import torch

from nerf_lightning.nerf.models.view_transformer.attention import RayAttention, ViewAttention, attend


def views(points=(4, 5), sources=3, width=8, dtype=torch.float32):
    torch.manual_seed(0)
    scores, values = (torch.randn(*points, sources, width, dtype=dtype) for _ in range(2))
    visible = torch.rand(*points, sources) < 0.6
    visible[0, 0], visible[0, 1] = False, True
    return scores, values, visible


def test_it_is_the_mean_under_a_softmax_of_what_is_visible():
    scores, values, visible = views()
    seen = attend(scores, values, visible)
    for point in (slice(0, 1), slice(1, 4)):
        weights = scores[point].masked_fill(~visible[point][..., None], -1e30).softmax(dim=-2)
        expected = (weights * values[point]).sum(dim=-2) * visible[point].any(dim=-1)[..., None]
        torch.testing.assert_close(seen[point], expected)


def test_its_gradients_are_those_of_its_differences():
    scores, values, visible = views((2, 2), dtype=torch.float64)
    scores, values = 3.0 * scores.requires_grad_(), values.requires_grad_()
    assert torch.autograd.gradcheck(lambda s, v: attend(s, v, visible), (scores, values))


def test_where_nothing_is_visible_all_is_0_and_gradients_are_finite():
    scores, values, visible = views()
    scores.requires_grad_(), values.requires_grad_()
    seen = attend(scores, values, torch.zeros_like(visible))
    assert torch.equal(seen, torch.zeros_like(seen))
    seen.sum().backward()
    assert torch.equal(scores.grad, torch.zeros_like(scores))
    assert torch.equal(values.grad, torch.zeros_like(values))


def looked(order, visible=None, other=False):
    torch.manual_seed(1)
    attention = ViewAttention(16)
    states, seen, turned = torch.randn(2, 3, 16), torch.randn(2, 3, 4, 16), torch.randn(2, 3, 4, 4)
    visible = torch.ones(2, 3, 4, dtype=torch.bool) if visible is None else visible
    if other:
        hidden = ~visible[..., None]
        seen, turned = torch.where(hidden, 100.0, seen), torch.where(hidden, -7.0, turned)
    return attention(states, seen[:, :, order], turned[:, :, order], visible[:, :, order])


def test_the_order_of_views_changes_nothing():
    torch.testing.assert_close(looked([2, 0, 3, 1]), looked([0, 1, 2, 3]))


def test_what_is_masked_changes_nothing():
    visible = torch.tensor([True, False, True, False]).expand(2, 3, 4)
    torch.testing.assert_close(looked([0, 1, 2, 3], visible, other=True), looked([0, 1, 2, 3], visible))
    torch.testing.assert_close(looked([0, 2], visible), looked([0, 1, 2, 3], visible))


def test_the_weights_of_samples_sum_to_1():
    torch.manual_seed(0)
    attention = RayAttention(16, 4)
    with_them, weights = attention(states := torch.randn(3, 5, 16), True)
    without, none = attention(states, False)
    assert none is None
    assert torch.equal(with_them, without)
    torch.testing.assert_close(weights.sum(dim=-1), torch.ones(3))
