"""Where `nerf table` writes, and that links in the folders it reads do not lead its files elsewhere."""

import os
import sys
from pathlib import Path

import pytest
from support.measured_runs import leave_measured_run

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.runs.output_folder import folder_around


def test_the_table_lies_in_the_folder_that_was_named(nerf, tmp_path):
    leave_measured_run(tmp_path / "runs" / "a")
    assert nerf("table", tmp_path / "runs").code == 0
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {"a", "table.csv", "table.md"}


def test_the_table_of_several_folders_lies_beside_them_or_here(nerf, tmp_path, monkeypatch):
    for place in ("runs/a", "runs/b", "elsewhere/c"):
        leave_measured_run(tmp_path / place)
    here = tmp_path / "here"
    here.mkdir()
    for folders, wanted in (
        (("runs/a", "runs/b"), tmp_path / "runs"),
        (("elsewhere", "elsewhere/c"), tmp_path / "elsewhere"),
        (("runs/a", "elsewhere/c"), here),
    ):
        monkeypatch.chdir(here)
        result = nerf("table", *(tmp_path / folder for folder in folders))
        assert result.code == 0, result.err
        assert (wanted / "table.csv").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["elsewhere", "here", "runs"]


def test_a_way_around_names_the_same_folder():
    runs = Path("runs").absolute()
    assert folder_around([Path("runs/a"), Path("runs/a/../b")]) == runs
    assert folder_around([Path("runs/a"), runs / "b"]) == runs
    assert folder_around([Path("runs/../runs")]) == runs


def test_no_table_lies_in_the_root():
    assert folder_around([Path("/data"), Path("/runs")]) == Path()
    assert folder_around([Path("/data/a"), Path("/home/b")]) == Path()


@pytest.mark.skipif(sys.platform == "win32", reason="symbolic links need rights there")
@pytest.mark.parametrize("name", [".table.{}.part.csv", ".table.{}.part.md", ".{}.probe", "table.md", "table.csv"])
def test_planted_links_are_not_written_through(nerf, tmp_path, name):
    victims = [tmp_path / "precious", tmp_path / "not_there"]
    victims[0].write_text("precious")
    for victim in victims:
        runs = tmp_path / f"runs_{victim.name}"
        leave_measured_run(runs / "a")
        (runs / name.format(os.getpid())).symlink_to(victim)
        result = nerf("table", runs)
        assert result.code == 0, result.err
        assert (runs / "table.md").read_text().startswith("| scene")
        assert not (runs / "table.md").is_symlink()
    assert victims[0].read_text() == "precious"
    assert not victims[1].exists()


@pytest.mark.skipif(sys.platform == "win32", reason="symbolic links need rights there")
def test_a_whole_file_does_not_follow_a_link_in_its_temporary_name(tmp_path):
    victim = tmp_path / "precious"
    victim.write_text("precious")
    with whole_file(tmp_path / "a.txt") as part:
        part.write_text("first")
    part.symlink_to(victim)
    with whole_file(tmp_path / "a.txt") as part:
        part.write_text("second")
    assert victim.read_text() == "precious"
    assert (tmp_path / "a.txt").read_text() == "second"
