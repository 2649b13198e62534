"""Choose which neurons of a hidden layer to keep (Ding et al. 2025, arXiv 2504.00950)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.nerf.fields.base import HiddenLayer
from nerf_lightning.nerf.randomness import batch_random, fold

By = Literal["importance", "coreset", "random", "activation"]
Side = Literal["out", "in", "both"]


@dataclass(frozen=True)
class Neurons:
    """A hidden layer's weights."""

    incoming: Float[Tensor, "neurons inputs"]
    """With the bias as its last column, if any."""
    outgoing: Float[Tensor, "outputs neurons"]
    """Weights of everything that reads the layer."""


@dataclass(frozen=True)
class Selection:
    """The neurons of a layer to keep."""

    numbers: Int[Tensor, "kept"]
    """Ascending."""
    factors: Float[Tensor, "kept"] | None = None
    """Factors of their outgoing weights; None: unchanged."""


def choose(
    layer: Neurons, count: int, by: By, weights: Side, activity: Float[Tensor, "neurons"] | None, key: int
) -> Selection:
    """Return the neurons of a layer to keep; if all are kept, they stay unchanged.

    Args:
        layer: its weights.
        count: the number to keep.
        by: the criterion. importance: the largest mean magnitude of weights; activation: the largest `activity`;
            random: a uniform choice; coreset: `coreset`.
        weights: those that importance uses.
        activity: mean magnitude of the neurons' activations.
        key: of the random numbers.
    """
    there = layer.incoming.shape[0]
    if count >= there:
        return Selection(torch.arange(there))
    if by == "coreset":
        return coreset(layer, count, _uniform(key, count))
    if by == "random":
        return _largest(_uniform(key, there), count)
    if by == "importance":
        return _largest(importance(layer, weights), count)
    assert activity is not None
    return _largest(activity, count)


def importance(layer: Neurons, weights: Side) -> Float[Tensor, "neurons"]:
    """Return the mean magnitude of each neuron's weights: outgoing, incoming, or all of them.

    >>> layer = Neurons(torch.tensor([[3.0, -1.0], [0.0, 1.0]]), torch.tensor([[-1.0, 5.0]]))
    >>> [importance(layer, side).tolist() for side in ("out", "in")]
    [[1.0, 5.0], [2.0, 0.5]]
    """
    out, into = layer.outgoing.abs(), layer.incoming.abs()
    sides = {"out": out, "in": into.t(), "both": torch.cat([out, into.t()])}
    return sides[weights].mean(dim=0)


def coreset(layer: Neurons, count: int, uniform: Float[Tensor, "draws"]) -> Selection:
    """Draw neurons with replacement, and weight them so that the next layer's sums stay the same in expectation.

    p ~ max|w_out| phi(b |w_in|), m draws, and the weight count / (m p) (Mussay et al., ICLR 2020, arXiv 1907.04018).
    With phi = ReLU the bound b of the inputs cancels. Neurons that are drawn twice leave slots free: undrawn ones fill
    them, the likeliest first, with their weight in the formula, 0, from which fine-tuning may raise them.

    Args:
        layer: the layer's weights.
        count: the number of neurons to keep.
        uniform: the m numbers in [0, 1) used to draw neurons.
    """
    sensitivity = (layer.outgoing.abs().amax(dim=0) * layer.incoming.norm(dim=1)).double()
    if not bool(sensitivity.sum() > 0):
        sensitivity = torch.ones_like(sensitivity)  # nothing is read, so all are equal
    p = sensitivity / sensitivity.sum()
    reach = p.cumsum(0)
    drawn = torch.searchsorted(reach, uniform.double() * reach[-1], right=True).clamp(max=p.numel() - 1)
    counts = torch.bincount(drawn, minlength=p.numel())
    order = torch.argsort((counts > 0) * 2.0 + p, descending=True, stable=True)
    numbers = order[:count].sort().values
    factors = torch.where(counts > 0, counts / (uniform.numel() * p.clamp(min=torch.finfo(p.dtype).tiny)), 0.0)
    return Selection(numbers, factors[numbers].to(layer.outgoing.dtype))


def _largest(scores: Tensor, count: int) -> Selection:
    return Selection(torch.argsort(scores, descending=True, stable=True)[:count].sort().values)


def _uniform(key: int, count: int) -> Float[Tensor, "count"]:
    return batch_random(fold(key, "prune"), count).uniform("neuron", 1)[:, 0]


def neurons_of(state: Mapping[str, Tensor], layer: HiddenLayer) -> Neurons:
    """Return the weights of a hidden layer."""
    matrix = state[layer.rows[0]]
    bias = [state[name][:, None] for name in layer.rows[1:2] if state[name].ndim == 1]
    readers = [state[name][:, : matrix.shape[0]] for name in layer.columns]
    return Neurons(torch.cat([matrix, *bias], dim=1), torch.cat(readers))


def narrowed(state: Mapping[str, Tensor], selections: Mapping[HiddenLayer, Selection]) -> dict[str, Tensor]:
    """Return a field's state with the kept neurons, in their original order."""
    narrow = dict(state)
    for layer, stays in selections.items():
        there = state[layer.rows[0]].shape[0]
        for name in layer.rows:
            narrow[name] = narrow[name].index_select(0, stays.numbers)
        for name in layer.columns:
            read = narrow[name][:, :there].index_select(1, stays.numbers)
            if stays.factors is not None:
                read = read * stays.factors
            narrow[name] = torch.cat([read, narrow[name][:, there:]], dim=1)
    return narrow
