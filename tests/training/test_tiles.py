"""Tiles beside each other: the same gradients as in turn, the same bits every time; and which one is taken."""

import copy

import pytest
import torch
from support.scenes import ball_scene, tiny_model
from support.static_models import fast_model
from support.steps import make_step

from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.nerf.models.ragged_level import RaggedLevel, average_counts
from nerf_lightning.nerf.part import fit_parts, sample_counts
from nerf_lightning.training.fastest_tile import fastest

MODELS = {"nerf": lambda: tiny_model(density_bias=0.5), "fast": lambda: fast_model(RaggedLevel)}


@pytest.fixture(params=MODELS)
def model(request):
    made = MODELS[request.param]()
    fit_parts(made, ball_scene())
    average_counts(made)
    return made


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def gradients_of(model, count, threads, backward=torch.Tensor.backward, tile_points=200):
    """What a step of 64 rays leaves in the parameters' gradients, and what it has lost, on so many threads."""
    threads(count)
    train_step = make_step(tile_points, copy.deepcopy(model))
    optimizer = train_step.new_optimizer()
    optimizer.zero_grad()
    batch = RayBatches(ball_scene(), train_step.progress, 0, 64).batch_at(0, 0)
    seen = train_step.gradients(batch, train_step.key, backward=backward)
    counts = torch.cat([count.float() for count in sample_counts(train_step.objective.model)] or [torch.zeros(1)])
    return torch.cat([p.grad.flatten() for p in train_step.objective.model.parameters()]), seen, counts


def test_beside_each_other_they_are_those_of_one_after_the_other_and_their_bits_the_same_every_time(model, threads):
    alone, seen_alone, counts_alone = gradients_of(model, 1, threads)
    beside, seen, counts = gradients_of(model, 3, threads)
    assert float(alone.norm()) > 0
    torch.testing.assert_close(beside, alone, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(seen.losses, seen_alone.losses)
    torch.testing.assert_close(seen.foreground, seen_alone.foreground)
    assert torch.equal(counts, counts_alone)
    first, *_ = gradients_of(model, 3, threads)
    for _ in range(5):
        assert torch.equal(gradients_of(model, 3, threads)[0], first)


def test_a_trainer_that_scales_the_loss_scales_the_gradients(model, threads):
    wanted, *_ = gradients_of(model, 2, threads)
    got, *_ = gradients_of(model, 2, threads, lambda loss: (4.0 * loss).backward())
    assert torch.equal(got, 4.0 * wanted)


@pytest.mark.parametrize(
    ("seconds", "best", "tried"),
    [
        # Overhead alone: the largest, and the next one shows that smaller ones are hopeless.
        ({4: 8.0, 16: 2.0, 64: 1.0}, 64, [64, 64, 16, 16]),
        # Large ones do not fit into the caches.
        ({4: 1.2, 16: 1.0, 64: 5.0}, 16, [64, 64, 16, 16, 4, 4]),
        # Hardly any gain: the smallest takes the least memory.
        ({4: 1.03, 16: 1.0, 64: 1.0}, 4, [64, 64, 16, 16, 4, 4]),
        ({4: 1.0}, 4, [4, 4]),
    ],
)
def test_the_fastest_tile_is_found_without_trying_hopeless_ones(seconds, best, tried):
    asked = []

    def measured(tile):
        asked.append(tile)
        return seconds[tile]

    assert fastest(tuple(seconds), measured)[0] == best
    assert asked == tried


def test_one_slow_moment_does_not_decide():
    moments = {4: [1.5, 1.5], 16: [9.0, 1.0], 64: [1.1, 9.0]}
    assert fastest((4, 16, 64), lambda tile: moments[tile].pop(0))[0] == 16
