"""The guard against steps whose gradients are not finite, on the CPU and on a device that is not there."""

import pytest
import torch
from support.stand_in_device import StandInDevice

from nerf_lightning.training.step_guard import StepGuard

NAN, INFINITE = float("nan"), float("inf")
GOOD = [1e-30, -0.0, -3.0]


def parameters_with(device, *gradients):
    for number, gradient in enumerate(gradients):
        parameter = torch.nn.Parameter(torch.zeros(len(gradient), device=device))
        parameter.grad = torch.zeros_like(parameter)
        for place, value in enumerate(gradient):
            parameter.grad[place] = value
        yield f"part{number}.weight", parameter


def steps_taken(guard, device):
    """Whether each step is allowed, and the gradients that are left."""
    for value in (1.0, NAN, -INFINITE, 1.0, INFINITE):
        named = list(parameters_with(device, GOOD, [], [1.0, value], [value]))
        losses = torch.full((2,), 0.5, device=device)
        allowed = guard.allows(losses, named)
        yield allowed, torch.cat([parameter.grad for _, parameter in named]).cpu()


def test_on_the_cpu_steps_are_left_out_and_counted():
    guard = StepGuard()
    assert [allowed for allowed, _ in steps_taken(guard, torch.device("cpu"))] == [True, False, False, True, False]
    assert guard.state() == [3, 1]
    assert guard.first_module == "part2"


@pytest.mark.parametrize("kind", ["cuda", "mps"])
def test_elsewhere_their_gradients_become_zeros_and_others_keep_their_bits(kind):
    guard = StepGuard()
    with StandInDevice(kind) as there:
        seen = list(steps_taken(guard, there.device))
        assert guard.state() == [3, 1]
        assert guard.first_module == "part2"
    for number, (allowed, left) in enumerate(seen):
        expected = torch.tensor([*GOOD, 1.0, 1.0, 1.0]) if number in (0, 3) else torch.zeros(6)
        assert allowed
        assert torch.equal(left.view(torch.int32), expected.view(torch.int32))


@pytest.mark.parametrize("losses", [[NAN, 0.0], [0.0, INFINITE]])
def test_a_loss_that_is_not_finite_is_the_first_where_no_gradient_shows_it(losses):
    guard = StepGuard()
    assert not guard.allows(torch.tensor(losses), parameters_with("cpu", GOOD))
    assert guard.first_module == "loss"
    assert guard.allows(torch.zeros(2), parameters_with("cpu", GOOD))
    assert guard.allows(torch.zeros(2), parameters_with("cpu", GOOD, [1e38, -1e38]))
    assert guard.state() == [1, 0]
