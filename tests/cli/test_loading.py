"""What takes the longest to load is loaded without a pause, and nothing else changes."""

import gc

from support.cold_import import cold_import

from nerf_lightning.cli.loading import quick_imports


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
