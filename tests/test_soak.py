"""What the soak calls growth; the soak itself is `make soak`."""

from soak import grows


def test_flat_is_not_growth():
    assert grows([300.0, 600.0, 800.0] + [900.0, 930.0] * 4, [6] * 11) is None


def test_memory_that_grows_is_told():
    assert grows([100.0 * number for number in range(1, 12)], [6] * 11) == "memory grew from 550 to 950 MB"


def test_files_that_stay_open_are_told():
    assert grows([900.0] * 8, [6] * 7 + [7]) == "open files grew from 6 to 7"


def test_a_few_rounds_prove_nothing():
    assert grows([100.0, 200.0, 900.0], [6, 7, 8]) is None
