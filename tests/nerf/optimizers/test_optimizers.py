import copy
import itertools
import math

import pytest
import torch

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.kernels.table_adam.op import AdamUpdate, adam_step_torch
from nerf_lightning.nerf.optimizers.schedule import Cooldown, ExponentialDecay
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
    optimizer.zero_grad()
    (table * 7).sum().backward()  # of a step that is not taken, nothing is left behind
    optimizer.zero_grad()
    assert bool((table.grad == 0).all())


def test_the_numba_twin_equals_the_reference():
    given = [torch.randn(5003) for _ in range(3)] + [torch.rand(5003)]
    given[1][::3] = 0
    numbers = 0.01, 1.3, 0.9, 0.99, 1e-15
    found_by_numba, reference = [x.clone() for x in given], [x.double() for x in given]
    update = AdamUpdate([tuple(found_by_numba)])
    update.set_numbers([numbers])
    update()
    adam_step_torch(*reference, *numbers)
    for found, expected in zip(found_by_numba, reference, strict=True):
        torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-6)


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


SCHEDULES = {
    "exponential": ExponentialDecay(decay_rate=0.03),
    "from the start": Cooldown(cooldown=1.0),
    "half": Cooldown(cooldown=0.5),
    "a tenth": Cooldown(cooldown=0.1),
}


@pytest.mark.parametrize("name", SCHEDULES)
@pytest.mark.parametrize("num_steps", [1, 7, 500])
def test_a_schedule_begins_with_the_whole_rate_never_rises_and_is_positive_in_the_run(name, num_steps):
    factors = [SCHEDULES[name](step, num_steps) for step in range(num_steps)]
    assert factors[0] == 1.0
    assert min(factors) > 0.0
    assert all(after <= before for before, after in itertools.pairwise(factors))


@pytest.mark.parametrize("cooldown", [0.1, 0.5, 1.0])
def test_the_rate_falls_in_a_straight_line_to_zero_at_the_end_alone(cooldown):
    schedule, begin = Cooldown(cooldown), round(1000 * (1.0 - cooldown))
    assert all(schedule(step, 1000) == pytest.approx(1.0, abs=1e-12) for step in range(begin + 1))
    falls = [schedule(step, 1000) - schedule(step + 1, 1000) for step in range(begin, 1000)]
    assert falls == pytest.approx([1.0 / (1000 * cooldown)] * len(falls), rel=1e-6)
    # What is trained beyond the end, as a budget that was overdrawn, changes nothing.
    assert schedule(1000, 1000) == schedule(1500, 1000) == 0.0


def test_a_longer_run_stretches_the_schedule_and_the_rise_while_warming_up_is_the_same_for_all():
    for schedule in SCHEDULES.values():
        assert schedule(30, 100) == pytest.approx(schedule(300, 1000))
    for one in (Cooldown(0.5, warmup_steps=4), ExponentialDecay(decay_rate=1.0, warmup_steps=4)):
        assert [one(step, 100) for step in range(5)] == [0.25, 0.5, 0.75, 1.0, 1.0]


@pytest.mark.parametrize("arguments", [{"cooldown": 0.0}, {"cooldown": 1.5}, {"warmup_steps": -1}])
def test_impossible_cooldowns_are_refused(arguments):
    with pytest.raises(ValueError, match="cooldown must be above 0"):
        Cooldown(**arguments)


@pytest.mark.parametrize(
    "settings", [{"lr": math.nan}, {"eps": math.inf}, {"weight_decay": -1.0}, {"betas": (0.9, 1.0)}]
)
def test_numbers_out_of_range_are_refused(settings):
    with pytest.raises(InputError, match="give a positive lr"):
        TableAdam([torch.nn.Parameter(torch.ones(1))], **settings)
