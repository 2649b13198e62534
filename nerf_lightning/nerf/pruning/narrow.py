"""Neurons taken out of a field's state: rows of what makes them, columns of what reads them."""

from collections.abc import Mapping

import torch
from torch import Tensor

from nerf_lightning.nerf.fields.base import HiddenLayer
from nerf_lightning.nerf.pruning.selection import Kept, Neurons


def neurons_of(state: Mapping[str, Tensor], layer: HiddenLayer) -> Neurons:
    """Return the weights of a hidden layer."""
    matrix = state[layer.rows[0]]
    # What a batch normalisation adds has one axis, too, and no part in what the matrix makes.
    bias = [state[name][:, None] for name in layer.rows[1:2] if state[name].ndim == 1]
    readers = [state[name][:, : matrix.shape[0]] for name in layer.columns]
    return Neurons(torch.cat([matrix, *bias], dim=1), torch.cat(readers))


def narrowed(state: Mapping[str, Tensor], kept: Mapping[HiddenLayer, Kept]) -> dict[str, Tensor]:
    """Return a field's state with the neurons that stay, in the order that they had."""
    narrow = dict(state)
    for layer, stays in kept.items():
        there = state[layer.rows[0]].shape[0]
        for name in layer.rows:
            narrow[name] = narrow[name].index_select(0, stays.numbers)
        for name in layer.columns:
            read = narrow[name][:, :there].index_select(1, stays.numbers)
            if stays.factors is not None:
                read = read * stays.factors
            narrow[name] = torch.cat([read, narrow[name][:, there:]], dim=1)
    return narrow
