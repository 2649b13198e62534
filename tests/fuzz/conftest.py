"""What damaged files must leave alone, and how many were tried."""

import os
from pathlib import Path

import pytest
from support.fuzzing import Counter

COUNTED = {"read": 0, "refused": 0}


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


def pytest_sessionfinish(session):
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput |= {"read": Counter.read, "refused": Counter.refused}
    else:
        COUNTED["read"] += Counter.read
        COUNTED["refused"] += Counter.refused


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    for kind in COUNTED:
        COUNTED[kind] += getattr(node, "workeroutput", {}).get(kind, 0)


def pytest_terminal_summary(terminalreporter):
    total = sum(COUNTED.values())
    terminalreporter.write_line(
        f"fuzzing: {total:,} damaged files, {COUNTED['read']:,} read as what they are, {COUNTED['refused']:,} refused"
    )
