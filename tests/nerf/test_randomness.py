import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from nerf_lightning.nerf.randomness import WORD, batch_random, fold, permute

ORDER_OF_432 = [317, 91, 319, 240, 180, 357]
ORDER_OF_TEN_TRILLION = [195157302707, 2420648577527, 2810723090951, 9025858086244]


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
    for key, purpose in (
        ((0, 0, 1), "jitter"),
        ((0, 1, 0), "jitter"),
        ((1, 0, 0), "jitter"),
        ((0, 0, 0), "importance"),
    ):
        other = batch_random(fold(*key), 64).uniform(purpose, 8)
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


def test_seed_zero_is_a_seed():
    assert fold(0, "rays") != fold("rays")
    assert len({fold(seed, 0, "weights") for seed in range(1000)}) == 1000


@settings(max_examples=25, deadline=None)
@given(size=st.integers(1, 1 << 20), key=st.integers(0, WORD))
@example(size=1 << 20, key=0)
@example(size=1, key=WORD)
@example(size=2, key=1)
@example(size=1023 * 1025, key=3)
def test_permute_is_a_bijection_of_any_size(size, key):
    places = permute(torch.arange(size), size, torch.tensor([key]))
    assert (int(places.min()), int(places.max())) == (0, size - 1)
    assert int(torch.bincount(places, minlength=size).max()) == 1


@settings(max_examples=25, deadline=None)
@given(size=st.integers(10**13 - 10**6, 10**13 + 10**6), start=st.integers(0, 10**13 - 10**6 - 8192))
def test_permute_of_ten_trillion_places_repeats_none(size, start):
    """10^13 pixels: 5 million photographs of 1080p. Products and sums must stay far below 2^63."""
    index = torch.cat([torch.arange(4096), start + torch.arange(4096), size - 1 - torch.arange(4096)]).unique()
    places = permute(index, size, torch.tensor([fold(0, "rays", 0)]))
    assert int(places.min()) >= 0
    assert int(places.max()) < size
    assert places.unique().numel() == index.numel()


def test_permute_is_the_same_with_one_key_for_all_or_one_for_each():
    index, key = torch.arange(1000), torch.tensor([fold(5)])
    alone = torch.stack([permute(index[number : number + 1], 1000, key)[0] for number in range(0, 1000, 50)])
    assert torch.equal(permute(index, 1000, key), permute(index, 1000, key.expand(1000)))
    assert torch.equal(permute(index, 1000, key)[::50], alone)


def test_permute_is_the_order_that_runs_have_had():
    """Numbers of an earlier version: another order would change every run that is resumed."""
    key = torch.tensor([fold(0, 0, "rays", 0)])
    assert permute(torch.arange(6), 432, key).tolist() == ORDER_OF_432
    assert permute(torch.arange(4), 10**13, key).tolist() == ORDER_OF_TEN_TRILLION


@pytest.mark.parametrize("seed", range(4))
def test_the_first_tenth_of_an_epoch_is_spread_over_images_and_places(seed):
    """Chi-square of 100 images of 100 x 60 pixels: over images, and over tiles of 10 x 10 pixels within an image."""
    width, height, images = 100, 60, 100
    size = width * height * images
    places = permute(torch.arange(size // 10), size, torch.tensor([fold(seed, 0, "rays", 0)]))
    within = places % (width * height)
    tile = within // width // 10 * (width // 10) + within % width // 10
    assert_even(torch.bincount(places // (width * height), minlength=images), share_left=0.9)
    assert_even(torch.bincount(tile, minlength=60), share_left=0.9)
    # A batch has no image of its own either.
    assert_even(torch.bincount(places[:8192] // (width * height), minlength=images))


def assert_even(counts, share_left=1.0):
    """Hold chi-square within 5 standard deviations of its mean; drawing without repeats makes it smaller."""
    expected = counts.sum() / counts.numel()
    chi_square = float(((counts - expected) ** 2 / expected).sum()) / share_left
    freedom = counts.numel() - 1
    assert abs(chi_square - freedom) < 5 * (2 * freedom) ** 0.5, chi_square
