"""The stand-in for a device is believed because it refuses what a device would, and says which line asked.

What it must not refuse, the models do (tests/training/test_every_model_on_stand_in.py).
"""

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
