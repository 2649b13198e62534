"""`nerf_lightning.nerf` is a library of its own, and every name that the stubs promise is there."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import nerf_lightning
from nerf_lightning import nerf

BLOCKED = "import sys; sys.modules |= dict.fromkeys({names!r})\n"
HEAVY = ("lightning", "pytorch_lightning", "hydra", "omegaconf", "tensorboard", "torchmetrics")
USE = """
from nerf_lightning import nerf
assert "torch" not in sys.modules
for name in {names!r}:
    assert getattr(nerf, name).__name__ == name
"""


def promised(package):
    return re.findall(r"as (\w+)$", Path(package.__file__).with_suffix(".pyi").read_text(), re.MULTILINE)


def test_every_name_is_there_without_lightning_and_hydra():
    assert {"RadianceModel", "composite", "FrequencyEncoder", "StratifiedSampler"} <= set(promised(nerf))
    code = BLOCKED.format(names=HEAVY) + USE.format(names=promised(nerf))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("package", [nerf_lightning, nerf])
def test_what_a_stub_promises_is_offered(package):
    assert set(promised(package)) <= set(dir(package))
    assert all(getattr(package, name).__name__ == name for name in promised(package))
    with pytest.raises(AttributeError, match="no attribute 'train_all'"):
        _ = package.train_all
