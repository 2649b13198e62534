"""The core is whole without extensions, in a copy of the project that lacks them.

That nothing of it imports them, the layers in pyproject.toml forbid. Here every test is collected, and those are run
that go through all options of the configs, and the main commands.
"""

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
TRIED = (
    *("test_configs.py", "test_setting_rules.py", "test_kept_checkpoints.py", "test_cli.py", "test_help.py"),
    *("test_completion.py", "test_train_eval_render.py", "test_export.py"),
)


@pytest.mark.exhaustive
def test_its_options_and_commands_work_without_them(tmp_path):
    for name in COPIED:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, tmp_path / name)
    shutil.rmtree(tmp_path / "nerf_lightning" / "extensions")
    # A module that cannot be imported ends the run, whether its tests are among those that are tried or not.
    quick = ["-m", "not slow and not exhaustive and not minutes", *(f"--ignore={name}" for name in DOCUMENTS)]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-n", "2", "--dist", "worksteal", *quick, "-k", " or ".join(TRIED), "tests"],
        cwd=tmp_path,
        env={key: value for key, value in os.environ.items() if not key.startswith("PYTEST")}
        | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-5000:]
