"""The core is whole without extensions: the quick tests pass in a copy of the project that lacks them."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = ("LICENSE", "README.md", "SECURITY.md")
COPIED = ("nerf_lightning", "conf", "docs", "tests", "conftest.py", "pyproject.toml", "Makefile", *PAGES)
DOCUMENTS = ("tests/test_documents.py", "tests/test_packaging.py")
"""They are of the whole project, and name commands and files of extensions."""


@pytest.mark.exhaustive
def test_the_quick_tests_pass_without_them(tmp_path):
    for name in COPIED:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, tmp_path / name)
    shutil.rmtree(tmp_path / "nerf_lightning" / "extensions")
    quick = ["-m", "not slow and not exhaustive and not minutes", *(f"--ignore={name}" for name in DOCUMENTS)]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-n", "2", "--dist", "worksteal", *quick, "tests"],
        cwd=tmp_path,
        env={key: value for key, value in os.environ.items() if not key.startswith("PYTEST")}
        | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-5000:]
