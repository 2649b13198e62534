"""Shared by all tests: a tiny scene, a tiny model, rays to look along, and float64 on demand."""

import os
import sys
from pathlib import Path

# Workers side by side have one thread each, and so has what they start; torch reads it while it is loaded.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
# As cli.py: threads that wait busily would take the time of others.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

sys.path.insert(0, str(Path(__file__).parent))

import pytest
import torch
from support import fork_server

MOST_THREADS = 1 if "PYTEST_XDIST_WORKER" in os.environ else 2


@pytest.fixture(autouse=True)
def _quiet_threads():
    """Two threads at most: more would only wait for each other on a small machine."""
    torch.set_num_threads(min(MOST_THREADS, torch.get_num_threads()))


@pytest.fixture(scope="session", autouse=True)
def _no_server_is_left():
    yield
    fork_server.stop()


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(20260101)
