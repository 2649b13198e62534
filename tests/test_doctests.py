"""The examples in the docstrings are true."""

import doctest
import importlib
from pathlib import Path

import pytest

import nerf_lightning

PACKAGE = Path(nerf_lightning.__file__).parent
WITH_EXAMPLES = [file for file in sorted(PACKAGE.rglob("*.py")) if ">>> " in file.read_text(encoding="utf-8")]


@pytest.mark.parametrize("file", WITH_EXAMPLES, ids=lambda file: file.stem)
def test_examples(file):
    name = ".".join(("nerf_lightning", *file.relative_to(PACKAGE).with_suffix("").parts))
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0
    assert result.failed == 0
