"""What `make help` shows; that it takes no tool of GNU's own, since macOS has BSD's, is a matter of its recipe."""

import re
import shutil
import subprocess

import pytest
from support.running import REPOSITORY

MAKEFILE = REPOSITORY / "Makefile"
TARGETS = re.findall(r"^([a-z-]+):.*## (.*)$", MAKEFILE.read_text(encoding="utf-8"), re.MULTILINE)


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_help_lists_every_target_in_two_columns():
    shown = subprocess.run(
        ["make", "--no-print-directory", "help"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    ).stdout
    assert shown.splitlines() == [f"{name:<20}{text}" for name, text in TARGETS]
    assert len(TARGETS) > 20
