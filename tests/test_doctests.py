"""The examples in the docstrings are true; what the soak calls growth (the soak itself is `make soak`)."""

import doctest
import importlib
from pathlib import Path

import pytest
from soak import grows

import nerf_lightning

PACKAGE = Path(nerf_lightning.__file__).parent
WITH_EXAMPLES = [file for file in sorted(PACKAGE.rglob("*.py")) if ">>> " in file.read_text(encoding="utf-8")]


@pytest.mark.parametrize("file", WITH_EXAMPLES, ids=lambda file: file.stem)
def test_examples(file):
    name = ".".join(("nerf_lightning", *file.relative_to(PACKAGE).with_suffix("").parts))
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0
    assert result.failed == 0


def test_growth_of_memory_and_of_open_files_is_told_and_flat_or_few_rounds_are_none():
    assert grows([300.0, 600.0, 800.0] + [900.0, 930.0] * 4, [6] * 11) is None
    assert grows([100.0 * number for number in range(1, 12)], [6] * 11) == "memory grew from 550 to 950 MB"
    assert grows([900.0] * 8, [6] * 7 + [7]) == "open files grew from 6 to 7"
    assert grows([100.0, 200.0, 900.0], [6, 7, 8]) is None
