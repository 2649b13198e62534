"""Training on XLA for real, on its CPU device: the same losses, compiled once, nothing sent back to the host."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from support.static_models import MODELS

from nerf_lightning.nerf.losses.mse import MeanSquaredError
from nerf_lightning.training.callbacks.checkpoints import Checkpoints

pytestmark = [
    pytest.mark.xla,
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),  # torch_xla renames what Lightning calls
]
# The grid's updates, in their three forms, come at steps 4, 8 and 12.
SETTLED = {"nerf": 2, "fast_dense": 13}


@pytest.mark.parametrize("name", MODELS)
def test_losses_equal_the_cpus_and_the_step_is_compiled_once(name, tmp_path):
    from support.xla_host import train

    there = train(tmp_path / "xla", name, "tpu", callbacks=[Checkpoints(every_steps=1000)])
    here = train(tmp_path / "cpu", name, "cpu")
    torch.testing.assert_close(there.losses, here.losses, rtol=1e-5, atol=0)
    assert there.system.train_step.guard.skipped == 0
    there.counters.require_quiet_after(SETTLED[name])
    saved = torch.load(tmp_path / "xla" / "checkpoints" / "last.ckpt", weights_only=True)
    for key, value in here.system.state_dict().items():
        assert saved["state_dict"][key].device.type == "cpu"
        # Adam turns rounding into steps where gradients are all but zero.
        close = torch.isclose(saved["state_dict"][key].double(), value.double(), rtol=1e-3, atol=1e-4)
        assert float(close.double().mean()) > 0.98, key


def test_products_are_bfloat16_and_weights_float32(tmp_path):
    from support.xla_host import train

    there = train(tmp_path / "xla", "nerf", "tpu", precision="bf16-mixed", steps=8)
    here = train(tmp_path / "cpu", "nerf", "cpu", precision="bf16-mixed", steps=8)
    exact = train(tmp_path / "exact", "nerf", "cpu", steps=8)
    assert {parameter.dtype for parameter in there.system.model.parameters()} == {torch.float32}
    torch.testing.assert_close(there.losses, here.losses, rtol=0.02, atol=0)
    assert float((there.losses - exact.losses).abs().max()) > 1e-6
    there.counters.require_quiet_after(SETTLED["nerf"])


class Planted(MeanSquaredError):
    def __init__(self, fault):
        super().__init__()
        self.fault = fault

    def forward(self, renderings, target):
        self.fault(renderings[-1].opacity.detach())
        return super().forward(renderings, target)


FAULTS = {
    "a number that is read": (lambda opacity: opacity.mean().item(), "numbers read"),
    "a shape that depends on data": (lambda opacity: opacity[opacity > opacity.mean()].sum().tolist(), "on the host"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_stops_the_device_is_noticed(fault, tmp_path):
    from support.xla_host import train

    planted, noticed = FAULTS[fault]
    run = train(tmp_path, "nerf", "tpu", steps=6, loss=Planted(planted))
    with pytest.raises(AssertionError, match=noticed):
        run.counters.require_quiet_after(SETTLED["nerf"])


@pytest.mark.parametrize("right", [False, True])
def test_a_search_stays_on_the_device(right, generator):
    from torch_xla.debug import metrics

    from nerf_lightning.nerf.kernels.search import search

    ordered = torch.rand(7, 20, generator=generator).sort(-1).values
    numbers = torch.cat([torch.rand(7, 30, generator=generator), ordered[:, ::3]], dim=-1)
    metrics.clear_all()
    found = search(ordered.to("xla"), numbers.to("xla"), right)
    assert torch.equal(found.cpu(), search(ordered, numbers, right))
    assert not [name for name in metrics.counter_names() if name.startswith("aten::")]


pytestmark = [pytest.mark.xla, pytest.mark.slow]
TESTS = Path(__file__).parents[1]

PROGRAM = """
import os
import sys
from pathlib import Path
import torch
from support.xla_host import XLAHostAccelerator, train
from nerf_lightning.compute import xla_device

xla_device.ACCELERATOR = XLAHostAccelerator
folder = Path(sys.argv[1])
there = train(folder / "xla", "nerf", "tpu", steps=8, devices="auto")
here = train(folder / "cpu", "nerf", "cpu", steps=8)
torch.testing.assert_close(there.losses, here.losses, rtol=1e-5, atol=0)
there.counters.require_quiet_after(2)
import torch_xla
spread = [torch_xla._XLAC._get_xla_sharding_spec(there.counters.weight)]
print("equal on", spread)
"""


def test_two_cores_share_a_batch_and_learn_what_one_learns(tmp_path):
    environment = {"PJRT_DEVICE": "CPU", "CPU_NUM_DEVICES": "2", "PYTHONPATH": f"{TESTS}{os.pathsep}{TESTS.parent}"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path)], env=os.environ | environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "equal on ['{devices=[2]" in done.stdout
