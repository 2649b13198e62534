import pytest

from nerf_lightning.data.sfm.image_pairs import chosen_matching, image_pairs, tiles_of


@pytest.mark.parametrize("count", [3, 12, 13, 81, 150])
@pytest.mark.parametrize("matching", ["exhaustive", "sequential", "auto"])
def test_pairs_are_ordered_and_unique_and_tiles_lose_none(count, matching):
    pairs = image_pairs(matching, count)
    assert len(set(pairs)) == len(pairs)
    assert all(0 <= i < j < count for i, j in pairs)
    tiles = tiles_of(pairs)
    assert sorted(pair for tile in tiles for pair in tile) == sorted(pairs)
    assert all(len({number for pair in tile for number in pair}) <= 24 for tile in tiles)
    assert {(i, i + 1) for i in range(count - 1)} <= set(pairs)


def test_auto_compares_all_pairs_of_a_few_photographs_only():
    assert chosen_matching("auto", 80) == "exhaustive"
    assert chosen_matching("auto", 81) == "sequential"
    assert len(image_pairs("auto", 80)) == 80 * 79 // 2


@pytest.mark.parametrize("count", [100, 400, 1000])
def test_sequential_pairs_grow_slowly_and_close_loops(count):
    pairs = set(image_pairs("sequential", count))
    assert len(pairs) < 25 * count
    # Somewhere the end of a closed path is compared with its beginning.
    assert any(j - i > 0.9 * count for i, j in pairs)
