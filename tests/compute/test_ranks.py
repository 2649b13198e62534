"""Shares of a batch, and what processes tell each other."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.scenes import ball_scene
from support.steps import gradients, make_step
from support.two_processes import in_two_processes

from nerf_lightning.compute import ranks
from nerf_lightning.data.ray_batches import RayBatches


@given(count=st.integers(0, 1000), parts=st.integers(1, 17))
def test_parts_cover_everything_once_and_are_as_equal_as_can_be(count, parts):
    slices = [ranks.part_of(count, number, parts) for number in range(parts)]
    assert [place for part in slices for place in range(count)[part]] == list(range(count))
    sizes = [part.stop - part.start for part in slices]
    assert max(sizes) - min(sizes) <= 1


@given(count=st.integers(0, 30), parts=st.integers(1, 7))
def test_what_is_dealt_out_comes_back_in_order(count, parts):
    dealt = [list(range(count))[number::parts] for number in range(parts)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ranks, "gather", lambda mine: dealt)
        assert ranks.in_turn(dealt[0]) == list(range(count))


@pytest.mark.parametrize("world", [2, 3])
def test_the_shares_of_a_step_add_up_to_the_step(monkeypatch, world):
    """With masks: a mean of 1 over the whole batch, not over a share."""
    scene = ball_scene()
    scene.pixels.__dict__["mask"] = torch.rand(scene.pixels.rgba.shape[0]) > 0.3
    whole, losses = gradients(make_step(100), scene)
    weight = RayBatches(scene, make_step(100).progress, 0, 64).batch_at(0, 0).weight.sum()
    total, total_losses = 0.0, 0.0
    for number in range(world):
        monkeypatch.setattr(ranks, "world_size", lambda: world)
        monkeypatch.setattr(ranks, "rank", lambda number=number: number)
        monkeypatch.setattr(ranks, "add_up", lambda tensors: list(tensors))
        monkeypatch.setattr(ranks, "total", lambda own: weight)
        part, part_losses = gradients(make_step(100), scene)
        total, total_losses = total + part, total_losses + part_losses
    assert torch.allclose(total, whole, atol=1e-6)
    assert torch.allclose(total_losses, losses, rtol=1e-5)


SUMS = """
from nerf_lightning.compute import ranks
random = torch.Generator().manual_seed(rank)
shapes = [(3,), (), (5, 7), (0,), (ranks.LARGE + 1,), (2, 3)]
parameters = [torch.nn.Parameter(torch.zeros(shape)) for shape in shapes]
for parameter in parameters[1:]:
    parameter.grad = torch.randn(parameter.shape, generator=random)
parameters[2].grad = torch.randn(7, 5, generator=random).mT
counts = torch.tensor([rank, 2])
own = [torch.zeros(3), *(parameter.grad.clone() for parameter in parameters[1:]), counts.clone()]
messages, reduce = [], distributed.all_reduce
distributed.all_reduce = lambda tensor, **how: (messages.append(tensor.numel()), reduce(tensor, **how))[1]
ranks.add_up_gradients(parameters)
ranks.add_up([counts])
result = own, [*(parameter.grad for parameter in parameters), counts], messages
"""


@pytest.mark.minutes
def test_two_processes_have_the_same_sums_in_a_message_for_all_small_tensors_of_a_type(tmp_path):
    (one, sums, messages), (other, same, _) = in_two_processes(SUMS, tmp_path)
    assert messages == [ranks.LARGE + 1, 3 + 1 + 35 + 6, 2]
    for added, again, left, right in zip(sums, same, one, other, strict=True):
        assert torch.equal(added, left + right)
        assert torch.equal(added, again)
