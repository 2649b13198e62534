"""What takes the longest to load is loaded without a pause, and nothing else changes."""

import gc
import subprocess
import sys

import pytest

from nerf_lightning.cli.loading import announce_start, quick_imports

LOADING = """
import gc
import pytest

from nerf_lightning.cli.loading import announce_start, quick_imports
with quick_imports():
    print(gc.isenabled())
    import nerf_lightning.commands.train
print(gc.isenabled(), gc.get_freeze_count() > 100_000)
"""


def test_the_collector_rests_while_lightning_is_loaded():
    done = subprocess.run([sys.executable, "-W", "error", "-c", LOADING], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.splitlines() == ["False", "True True"]


def test_later_jobs_of_a_sweep_leave_nothing_behind():
    import lightning  # noqa: F401

    before = gc.get_freeze_count()
    with quick_imports():
        assert gc.isenabled()
    assert gc.get_freeze_count() <= before


@pytest.mark.parametrize(
    ("terminal", "arguments", "lines"),
    [(True, ["seed=1", "-m"], 1), (False, ["seed=1"], 0), (True, ["--cfg", "job"], 0)],
)
def test_a_terminal_is_told_at_once_that_a_command_starts(monkeypatch, capsys, terminal, arguments, lines):
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    announce_start("train", arguments)
    assert capsys.readouterr().err.splitlines() == ["nerf train starts; loading PyTorch takes a few seconds"] * lines
