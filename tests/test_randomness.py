import pytest
import torch

from nerf_lightning.randomness import batch_random, fold, mix, permute


def test_uniform_numbers_fill_the_interval_evenly():
    numbers = batch_random(fold(0, 0, 0), 4096).uniform("jitter", 32).flatten()
    counts = torch.histc(numbers, 64, 0.0, 1.0)
    expected = numbers.numel() / 64
    chi_square = float(((counts - expected) ** 2 / expected).sum())
    assert 25 < chi_square < 120  # 63 degrees of freedom: mean 63, standard deviation 11
    assert float(numbers.min()) >= 0.0
    assert float(numbers.max()) < 1.0


@pytest.mark.parametrize("axis", [0, 1])
def test_neighbouring_numbers_are_not_correlated(axis):
    numbers = batch_random(fold(3, 0, 17), 2048).uniform("jitter", 64) - 0.5
    shifted = numbers.roll(1, dims=axis)
    assert abs(float((numbers * shifted).mean()) * 12) < 0.01


def test_each_ray_step_seed_attempt_and_purpose_has_its_own_numbers():
    base = batch_random(fold(0, 0, 0), 64).uniform("jitter", 8)
    others = [
        batch_random(fold(0, 0, 1), 64).uniform("jitter", 8),
        batch_random(fold(0, 1, 0), 64).uniform("jitter", 8),
        batch_random(fold(1, 0, 0), 64).uniform("jitter", 8),
        batch_random(fold(0, 0, 0), 64).uniform("importance", 8),
    ]
    for other in others:
        assert float((base == other).float().mean()) < 0.01
    assert base.unique().numel() > 500  # no two rays share a jitter


def test_numbers_of_a_tile_are_those_of_the_whole_batch():
    random = batch_random(fold(5, 0, 9), 100)
    whole = random.uniform("jitter", 7)
    assert torch.equal(torch.cat([random[:33].uniform("jitter", 7), random[33:].uniform("jitter", 7)]), whole)


def test_normal_numbers_have_mean_zero_and_variance_one():
    numbers = batch_random(fold(1), 4096).normal("noise", 16)
    assert abs(float(numbers.mean())) < 0.02
    assert abs(float(numbers.var()) - 1.0) < 0.03


def test_mix_is_a_bijection_on_a_sample():
    words = torch.arange(1 << 18) * 16381 % (1 << 32)
    assert mix(words).unique().numel() == words.numel()
    assert int(mix(words).min()) >= 0
    assert int(mix(words).max()) < 1 << 32


def test_seed_zero_is_a_seed():
    assert fold(0, "rays") != fold("rays")
    assert len({fold(seed, 0, "weights") for seed in range(1000)}) == 1000


@pytest.mark.parametrize("size", [1, 2, 3, 7, 100, 1009, 65_536])
def test_permute_visits_every_place_once(size):
    places = permute(torch.arange(size), size, torch.full((size,), fold(size)))
    assert torch.equal(places.sort().values, torch.arange(size))


def test_permute_carries_neighbours_far_apart():
    size = 1_000_000
    places = permute(torch.arange(4096), size, torch.full((4096,), fold(0, "rays")))
    gaps = places.diff().abs().double()
    assert abs(float(gaps.mean()) / size - 1 / 3) < 0.02  # as for independent uniform places


def test_permute_of_another_key_is_another_order():
    keys = [torch.full((512,), fold(0, 0, epoch)) for epoch in range(2)]
    first, second = (permute(torch.arange(512), 512, key) for key in keys)
    assert float((first == second).float().mean()) < 0.05
