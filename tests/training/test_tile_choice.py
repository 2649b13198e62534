"""Which tile is taken, and which are not even tried."""

import pytest

from nerf_lightning.training.tile_size import fastest


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

    assert fastest(tuple(seconds), measured) == best
    assert asked == tried


def test_one_slow_moment_does_not_decide():
    moments = {4: [1.5, 1.5], 16: [9.0, 1.0], 64: [1.1, 9.0]}
    assert fastest((4, 16, 64), lambda tile: moments[tile].pop(0)) == 16
