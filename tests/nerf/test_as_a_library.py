"""`nerf_lightning.nerf` is a library of its own: neither Lightning nor Hydra is needed, and names are found."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from nerf_lightning import nerf

WITHOUT = """
import sys
for name in ("lightning", "pytorch_lightning", "hydra", "omegaconf", "tensorboard", "torchmetrics"):
    sys.modules[name] = None
from nerf_lightning import nerf
assert "torch" not in sys.modules
for name in nerf._OFFERED:
    assert getattr(nerf, name).__name__ == name
"""


def test_every_name_is_there_without_lightning_and_hydra():
    done = subprocess.run([sys.executable, "-c", WITHOUT], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "RadianceModel" in dir(nerf)
    with pytest.raises(AttributeError, match="no attribute 'RadianceModels'"):
        _ = nerf.RadianceModels


def test_the_types_that_are_told_are_those_of_what_is_there():
    stub = ast.parse(Path(nerf.__file__).with_suffix(".pyi").read_text())
    told = {each.names[0].asname: each.module for each in stub.body if isinstance(each, ast.ImportFrom)}
    assert told == nerf._OFFERED
