"""What takes the longest to load is loaded without a pause, and nothing else changes."""

import gc
import sys

import pytest
from support.cold_import import cold_import

from nerf_lightning.cli.loading import announce_start, quick_imports


def test_the_collector_rests_while_lightning_is_loaded(tmp_path_factory):
    during, _, after, *_ = cold_import(tmp_path_factory)
    assert during == "False"
    assert after == "True True"


def test_scipys_signals_are_not_loaded_before_somebody_asks_for_them(tmp_path_factory):
    _, loaded, *_, asked = cold_import(tmp_path_factory)
    assert loaded == "[]"
    assert asked == "3 True"


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
