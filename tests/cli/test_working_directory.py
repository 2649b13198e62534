"""What lies in the folder that `nerf` is called in is neither imported nor obeyed."""

import os
import subprocess
import sys

import pytest
from support.captures import write_npz
from support.running import FAST, REPOSITORY, output_of, start_cold

from nerf_lightning.cli import process

PLANTED = ("torch", "numpy", "numba", "hydra", "lightning", "yaml", "psutil", "multiprocessing")
SPAWN = """
import multiprocessing
from nerf_lightning.cli.process import keep_from_subprocesses
if __name__ == "__main__":
    keep_from_subprocesses()
    child = multiprocessing.get_context("spawn").Process(target=print, args=("spawned",))
    child.start()
    child.join()
"""


@pytest.fixture
def strange_folder(tmp_path):
    """A folder with modules that leave a mark where they are imported."""
    folder = tmp_path / "strange"
    folder.mkdir()
    for name in PLANTED:
        (folder / f"{name}.py").write_text(f"open({str(tmp_path / 'mark')!r}, 'a').write('{name} ')\n")
    yield folder
    assert not (tmp_path / "mark").exists(), (tmp_path / "mark").read_text()


def test_a_process_started_with_m_imports_nothing_from_it(strange_folder):
    assert "logger" in output_of(start_cold("nerf_lightning", "train", "--cfg", "job", cwd=strange_folder))


@pytest.mark.minutes
def test_neither_do_the_processes_of_one_run(strange_folder, tmp_path):
    write_npz(tmp_path / "ball.npz")
    settings = ["scene=npz", f"scene.path={tmp_path}/ball.npz", *FAST, "final.evaluate=false", "final.video=false"]
    two = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", f"paths.output_dir={tmp_path}/run"]
    output_of(start_cold("nerf_lightning", "train", *settings, *two, cwd=strange_folder))
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").is_file()


def test_neither_do_processes_that_libraries_start(strange_folder, tmp_path):
    (tmp_path / "main.py").write_text(SPAWN)
    done = subprocess.run(
        [sys.executable, tmp_path / "main.py"], cwd=strange_folder, capture_output=True, text=True, check=True
    )
    assert done.stdout == "spawned\n"


def test_a_clone_that_is_not_installed_is_found_by_them(monkeypatch):
    found = [place for place in sys.path if os.path.realpath(place) != os.path.realpath(REPOSITORY)]
    monkeypatch.setattr(sys, "path", found)
    monkeypatch.setattr(os, "environ", os.environ | {"PYTHONPATH": "of the user"})
    process.keep_from_subprocesses()
    assert sys.path[-1] == str(REPOSITORY)
    assert os.environ["PYTHONPATH"].split(os.pathsep) == ["of the user", str(REPOSITORY)]


@pytest.mark.parametrize("name", [".numba_config.yaml", "matplotlibrc"])
def test_settings_of_libraries_are_refused_before_anything_is_done(tmp_path, name):
    (tmp_path / name).write_bytes(b"cache_dir: elsewhere\n\xff")
    command = ["doctor", "scene=npz", "scene.path=nowhere.npz", f"paths.output_dir={tmp_path}/run"]
    process = start_cold("nerf_lightning", *command, cwd=tmp_path)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 2
    assert output.startswith(f"nerf: The working directory has a file {name}, which would be read by ")
    assert len(output.splitlines()) == 1
    assert not (tmp_path / "run").exists()
