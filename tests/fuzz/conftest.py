"""What damaged files must leave alone."""

import os
from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def _nothing_elsewhere(tmp_path_factory, monkeypatch):
    """Work in an empty folder, with an empty home: both stay empty."""
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    for name in ("work", "home", "cache"):
        (elsewhere / name).mkdir()
    monkeypatch.chdir(elsewhere / "work")
    monkeypatch.setenv("HOME", str(elsewhere / "home"))
    monkeypatch.setenv("MPLCONFIGDIR", str(tmp_path_factory.getbasetemp() / "fonts"))
    monkeypatch.setenv("NERF_LIGHTNING_CACHE", str(elsewhere / "cache"))
    yield
    left = [str(Path(base) / name) for base, _, names in os.walk(elsewhere) for name in names]
    assert left == []
