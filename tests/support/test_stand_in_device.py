"""The stand-in for a device is believed because it refuses what a device would, and says which line asked.

What it must not refuse, the models do (tests/training/test_every_model_on_stand_in.py).
"""

import re

import pytest
import torch
from support.stand_in_device import Refused, StandInDevice

REFUSED = {
    "operands lie apart": [
        lambda there, host: there + host,
        lambda there, host: torch.cat([there, host]),
        lambda there, host: torch.where(there > 0, there, host),
        lambda there, host: there.index_add_(0, host.long(), there),
        lambda there, host: torch.nn.functional.linear(there, host[None]),
    ],
    "NumPy": [lambda there, host: there.numpy(), lambda there, host: there.detach().__array__()],
}
REFUSED_IN_STEPS = {
    "the host reads": [
        lambda there, host: there.sum().item(),
        lambda there, host: bool((there > 0).any()),
        lambda there, host: torch.equal(there, there),
        lambda there, host: there.nonzero(),
        lambda there, host: there[there > 0],
        lambda there, host: there.__setitem__(there > 1, there[:2].clone()),
        lambda there, host: there.repeat_interleave(there.long()),
        lambda there, host: host[there[1].long()],
    ],
    "copied to the host": [
        lambda there, host: there.cpu(),
        lambda there, host: host.copy_(there),
    ],
    "pageable": [
        lambda there, host: host.to(there.device),
        lambda there, host: there.copy_(host),
        lambda there, host: torch.tensor([1.0, 2.0], device=there.device),
        lambda there, host: there[host.long() - 1],
        lambda there, host: there[[0, 1]],
    ],
    "float64": [
        lambda there, host: there.double(),
        lambda there, host: there.sum(dtype=torch.float64),
        lambda there, host: torch.zeros(3, dtype=torch.float64, device=there.device),
    ],
}


def flat(cases):
    return [(message, case) for message, of in cases.items() for case in of]


@pytest.fixture(params=["cuda", "mps"])
def there(request):
    with StandInDevice(request.param) as device:
        yield device


def both(device):
    host = torch.tensor([1.0, 2.0, 3.0])
    return host.to(device.device), host


@pytest.mark.parametrize(("message", "case"), flat(REFUSED))
def test_what_a_device_cannot_do_is_refused(message, case, there):
    with pytest.raises(Refused, match=message):
        case(*both(there))


@pytest.mark.parametrize(("message", "case"), flat(REFUSED_IN_STEPS))
def test_what_makes_a_step_wait_is_refused_in_steps_alone(message, case, there):
    there_and_host = both(there)
    if message != "float64" or there.device.type == "cuda":
        case(*there_and_host)
    with there.in_step(), pytest.raises(Refused, match=message):
        case(*there_and_host)


@pytest.mark.parametrize("case", [case for message, case in flat(REFUSED_IN_STEPS) if message == "float64"])
def test_a_device_without_float64_refuses_it_always(case):
    with StandInDevice("mps") as device, pytest.raises(Refused, match="float64"):
        case(*both(device))
    with StandInDevice("mps") as device, pytest.raises(Refused, match="float64"):
        torch.ones(2, dtype=torch.float64).to(device.device)


def test_tensors_say_where_they_lie(there):
    moved, host = both(there)
    assert (moved.device, host.device) == (there.device, torch.device("cpu"))
    assert [moved.is_cuda, moved.is_mps, moved.is_cpu] == [there.device.type == kind for kind in ("cuda", "mps", "cpu")]
    assert [host.is_cuda, host.is_mps, host.is_cpu] == [False, False, True]
    assert (moved[1:].exp().device, moved.cpu().device) == (there.device, torch.device("cpu"))
    module = torch.nn.Linear(3, 2).to(there.device)
    assert {each.device for each in module.parameters()} == {there.device}
    module(moved).sum().backward()
    assert module.weight.grad.device == there.device
    assert torch.equal(moved.cpu(), host)


class Reading(torch.autograd.Function):
    @staticmethod
    def forward(ctx, numbers):
        return numbers.clone()

    @staticmethod
    def backward(ctx, grad):
        return grad * float(grad.sum())


class Apart(Reading):
    @staticmethod
    def backward(ctx, grad):
        return grad * torch.ones(3)


@pytest.mark.parametrize(("function", "message"), [(Reading, "the host reads"), (Apart, "operands lie apart")])
def test_the_way_back_is_watched_too(function, message, there):
    leaf = both(there)[0].requires_grad_()
    out = function.apply(leaf).sum()
    with there.in_step(), pytest.raises(Refused, match=message):
        out.backward()
    with there.in_step(), pytest.raises(Refused, match=message):
        torch.autograd.grad(function.apply(leaf).sum(), leaf)


def read_here(numbers):
    return float(numbers.sum())


def test_an_error_names_the_line_and_what_is_named_is_counted(there):
    moved, _ = both(there)
    line = read_here.__code__.co_firstlineno + 1
    expected = re.escape(f"tests/support/test_stand_in_device.py:{line}: the host reads")
    with there.in_step("read_there"), pytest.raises(Refused, match=expected):
        read_here(moved)
    with there.in_step("read_here"):
        assert [read_here(moved), read_here(moved)] == [6.0, 6.0]
    assert there.waited == {"read_here": 2}
