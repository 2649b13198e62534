"""The wheel is enough: conf/ travels inside the package; `make help` shows what there is to do."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile

import pytest
from support.running import REPOSITORY


def python(*arguments, cwd, **env):
    done = subprocess.run([sys.executable, *arguments], cwd=cwd, env=os.environ | env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def built(kind, folder):
    """Return the archive of a kind that is made of this checkout."""
    python("-m", "hatchling", "build", "-t", kind, "-d", str(folder), cwd=REPOSITORY)
    (archive,) = folder.iterdir()
    return archive


def test_what_is_published_says_how_to_contribute_and_whom_to_tell_of_holes(tmp_path):
    with tarfile.open(built("sdist", tmp_path)) as content:
        names = {name.partition("/")[2] for name in content.getnames()}
    assert {"README.md", "LICENSE", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md"} <= names


@pytest.mark.slow
def test_a_wheel_installed_elsewhere_gives_a_working_nerf(tmp_path):
    with zipfile.ZipFile(built("wheel", tmp_path / "dist")) as content:
        names = set(content.namelist())
        packed = {name for name in names if name.startswith("nerf_lightning/conf/")}
        content.extractall(tmp_path / "site")
    ours = {f"nerf_lightning/{file.relative_to(REPOSITORY)}" for file in (REPOSITORY / "conf").rglob("*.yaml")}
    assert packed == ours
    assert {"nerf_lightning/extensions/pruning/conf/prune.yaml", "nerf_lightning/data/bricks/fire_engine.txt"} <= names
    assert [name for name in names if "tests/" in name or "conftest" in name] == []
    elsewhere = {"cwd": tmp_path, "PYTHONPATH": str(tmp_path / "site")}
    where = python("-c", "import nerf_lightning.files.folders as c; print(c.conf_folder())", **elsewhere)
    assert where.strip() == str(tmp_path / "site" / "nerf_lightning" / "conf")
    composed = python("-m", "nerf_lightning", "train", "model=view_transformer", "--cfg", "job", **elsewhere)
    assert "ViewTransformer" in composed
    assert "val_every_steps: " in composed
    assert "nerf prune ckpt=RUN" in python("-m", "nerf_lightning", "prune", "--help", **elsewhere)
    assert "scene.images=null" in python("-m", "nerf_lightning", "help", "scene=colmap", **elsewhere)
    assert "complete -c nerf" in python("-m", "nerf_lightning", "completion", "fish", **elsewhere)


MAKEFILE = REPOSITORY / "Makefile"
TARGETS = re.findall(r"^([a-z-]+):.*## (.*)$", MAKEFILE.read_text(encoding="utf-8"), re.MULTILINE)


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_help_lists_every_target_in_two_columns():
    shown = subprocess.run(
        ["make", "--no-print-directory", "help"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    ).stdout
    assert shown.splitlines() == [f"{name:<20}{text}" for name, text in TARGETS]
    assert len(TARGETS) > 20
