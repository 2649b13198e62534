"""How far something is, where no terminal could show a bar."""

import itertools
import logging

import pytest

from nerf_lightning.messages import console


@pytest.fixture
def told(monkeypatch, caplog):
    """Let every reading of the clock be 20 s later; return what was told."""
    clock = itertools.count(0.0, 20.0)
    monkeypatch.setattr(console.time, "monotonic", lambda: next(clock))
    caplog.set_level(logging.INFO)
    return lambda: [record.getMessage() for record in caplog.records]


def test_items_that_take_long_are_told_in_lines(told):
    assert list(console.tracked(range(5), "filming")) == [0, 1, 2, 3, 4]
    assert told() == ["filming: 20 %, about 2 min 40 s left", "filming: 60 %, about 53 s left"]


def test_stages_are_told_in_lines_with_the_share_of_the_whole(told):
    with console.StageProgress({"matching": 3.0, "reconstruction": 1.0}) as report:
        for stage, fraction in (("matching", 0.0), ("matching", 0.5), ("reconstruction", 0.0), ("reconstruction", 1.0)):
            report(stage, fraction)
    assert [line.partition(", about")[0] for line in told()] == ["matching: 38 %"]


def test_nobody_is_told_of_what_is_quick(monkeypatch, caplog):
    caplog.set_level(logging.INFO)
    list(console.tracked(range(1000), "filming"))
    assert not caplog.records
