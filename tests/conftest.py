"""Shared by all tests: a tiny scene, a tiny model, rays to look along, and float64 on demand."""

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True)
def _quiet_threads():
    """Two threads at most: more would only wait for each other on a small machine."""
    torch.set_num_threads(min(2, torch.get_num_threads()))


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(20260101)
