import copy

import pytest
import torch

from nerf_lightning.nerf.kernels.adam.step import adam_step_torch
from nerf_lightning.nerf.optimizers.table_adam import TableAdam


def trained(optimizer_class, steps, **settings):
    torch.manual_seed(0)
    weight = torch.nn.Parameter(torch.randn(40, 3))
    target = torch.randn(40, 3)
    optimizer = optimizer_class([weight], **settings)
    for _ in range(steps):
        optimizer.zero_grad()
        (weight - target).square().sum().backward()
        optimizer.step()
    return weight.detach()


def test_where_every_entry_has_a_gradient_it_is_adam():
    settings = {"lr": 0.05, "betas": (0.9, 0.99), "eps": 1e-15, "weight_decay": 0.01}
    torch.testing.assert_close(trained(TableAdam, 20, **settings), trained(torch.optim.Adam, 20, **settings))


def test_entries_without_a_gradient_stay_where_they_are():
    """The fault: momentum moves entries that no point of the batch has touched."""
    table = torch.nn.Parameter(torch.ones(6, 2))
    optimizer = TableAdam([table], lr=0.1)
    for rows in ([0, 1], [1, 2], [2]):
        optimizer.zero_grad()
        table[rows].sum().backward()
        optimizer.step()
    assert bool((table[3:] == 1).all())
    assert float(table.detach()[0, 0]) == pytest.approx(0.9)  # one step and no more
    assert bool((table.grad == 0).all())


def test_the_numba_twin_equals_the_reference():
    given = [torch.randn(5000) for _ in range(3)] + [torch.rand(5000)]
    given[1][::3] = 0
    results = []
    from nerf_lightning.nerf.kernels.adam.step import adam_step

    for fn, dtype in ((adam_step, torch.float32), (adam_step_torch, torch.float64)):
        arrays = [x.clone().to(dtype) for x in given]
        fn(*arrays, 0.01, 1.3, (0.9, 0.99), 1e-15)
        results.append(arrays)
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-6)


def test_a_step_that_was_not_taken_leaves_no_gradients_behind():
    table = torch.nn.Parameter(torch.ones(4))
    optimizer = TableAdam([table], lr=0.1)
    optimizer.zero_grad()
    (table * 7).sum().backward()
    optimizer.zero_grad()
    assert bool((table.grad == 0).all())


def test_its_state_can_be_saved_and_taken_up():
    torch.manual_seed(1)
    one = torch.nn.Parameter(torch.randn(9))
    first = TableAdam([one], lr=0.1)
    for _ in range(3):
        first.zero_grad()
        one.square().sum().backward()
        first.step()
    two = torch.nn.Parameter(one.detach().clone())
    second = TableAdam([two], lr=0.1)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    for optimizer, weight in ((first, one), (second, two)):
        optimizer.zero_grad()
        weight.square().sum().backward()
        optimizer.step()
    assert torch.equal(one, two)
