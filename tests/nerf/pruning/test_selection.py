"""Which neurons stay, and that what is drawn is right on average."""

import pytest
import torch

from nerf_lightning.nerf.pruning.selection import Neurons, choose, coreset, importance


def some_neurons(count=40):
    generator = torch.Generator().manual_seed(0)
    incoming = torch.randn(count, 12, generator=generator) * torch.rand(count, 1, generator=generator)
    return Neurons(incoming, torch.randn(9, count, generator=generator) * torch.rand(count, generator=generator))


@pytest.mark.parametrize("by", ["importance", "coreset", "random", "activation"])
def test_so_many_stay_in_their_order_and_all_of_them_as_they_are(by):
    layer, activity = some_neurons(), torch.rand(40)
    few = choose(layer, 15, by, "out", activity, key=3)
    assert few.numbers.unique().numel() == 15
    assert torch.equal(few.numbers, few.numbers.sort().values)
    every = choose(layer, 40, by, "out", activity, key=3)
    assert torch.equal(every.numbers, torch.arange(40))
    assert every.factors is None


def test_what_counts_most_stays():
    layer = Neurons(torch.tensor([[1.0, 1], [0, 4], [9, 9]]), torch.tensor([[5.0, -1, 1], [1, 3, 0]]))
    assert importance(layer, "both").tolist() == [2.0, 2.0, 4.75]
    assert choose(layer, 1, "importance", "out", None, 0).numbers.tolist() == [0]
    assert choose(layer, 1, "importance", "in", None, 0).numbers.tolist() == [2]
    assert choose(layer, 2, "activation", "out", torch.tensor([0.1, 3.0, 2.0]), 0).numbers.tolist() == [1, 2]


def test_a_choice_at_random_is_even_and_one_of_its_key():
    layer = some_neurons(8)
    counts = torch.zeros(8)
    for key in range(200):
        counts[choose(layer, 4, "random", "out", None, key).numbers] += 1
    assert bool(((counts - 100).abs() < 36).all()), counts  # five standard deviations
    again = [choose(layer, 4, "random", "out", None, 5).numbers for _ in range(2)]
    assert torch.equal(*again)


def test_the_next_layer_sums_the_same_over_many_coresets():
    """The mean over draws of sum_j w_j count_j / (m p_j) a_j is the whole layer's sum."""
    layer, generator = some_neurons(), torch.Generator().manual_seed(1)
    activations = torch.rand(40, generator=generator)
    exact = layer.outgoing @ activations
    sums = []
    for _ in range(1000):
        kept = coreset(layer, 16, torch.rand(16, generator=generator))
        sums.append(layer.outgoing[:, kept.numbers] * kept.factors @ activations[kept.numbers])
    found = torch.stack(sums)
    error = (found.mean(dim=0) - exact) / (found.std(dim=0) / len(sums) ** 0.5)
    assert float(error.abs().max()) < 4.5, error
    assert float(found.std(dim=0).min()) > 0.1  # one draw alone is far off


def test_a_coreset_by_hand():
    """P = (0.6, 0.1, 0.3); of four draws three are the first neuron, and an undrawn one takes the free place."""
    layer = Neurons(torch.tensor([[3.0], [1.0], [1.0]]), torch.tensor([[2.0, 1.0, -3.0]]))
    kept = coreset(layer, 3, torch.tensor([0.0, 0.2, 0.59, 0.65]))
    assert kept.numbers.tolist() == [0, 1, 2]
    torch.testing.assert_close(kept.factors, torch.tensor([3 / (4 * 0.6), 1 / (4 * 0.1), 0.0]))
    assert coreset(layer, 2, torch.tensor([0.0, 0.1])).numbers.tolist() == [0, 2]


def test_neurons_that_nothing_reads_are_drawn_alike():
    kept = coreset(Neurons(torch.rand(6, 3), torch.zeros(2, 6)), 3, torch.tensor([0.1, 0.55, 0.9]))
    assert kept.numbers.tolist() == [0, 3, 5]
    assert kept.factors.tolist() == [2.0, 2.0, 2.0]
