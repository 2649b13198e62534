import numpy as np
import pytest
import torch

from nerf_lightning.nerf.kernels.search import search, search_by_comparison


@pytest.mark.parametrize("right", [False, True])
@pytest.mark.parametrize("way", [search, search_by_comparison])
def test_every_way_finds_what_numpy_finds(way, right, generator):
    ordered = torch.rand(5, 13, generator=generator).sort(-1).values
    ordered[:, 4] = ordered[:, 3]  # equal neighbours
    numbers = torch.cat([torch.rand(5, 20, generator=generator) * 1.4 - 0.2, ordered], dim=-1)
    found = way(ordered, numbers, right)
    for row in range(5):
        expected = np.searchsorted(ordered[row].numpy(), numbers[row].numpy(), side="right" if right else "left")
        assert found[row].tolist() == expected.tolist()


def test_devices_without_a_search_of_their_own_compare(monkeypatch):
    monkeypatch.setattr(torch, "searchsorted", None)
    assert search(torch.ones(2, 3, device="meta"), torch.ones(2, 5, device="meta")).shape == (2, 5)
