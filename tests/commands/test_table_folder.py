"""Where `nerf table` writes, and that links in the folders it reads do not lead its files elsewhere."""

import os
import sys

import pytest
from support.measured_runs import leave_measured_run

from nerf_lightning.files.atomic import whole_file

FILES = {"table.csv", "table.html", "table.md"}


def test_files_are_written_only_where_they_are_asked_for(nerf, tmp_path, monkeypatch):
    leave_measured_run(tmp_path / "runs" / "a")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert nerf("table", tmp_path / "runs").code == 0
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["a"]
    assert list((tmp_path / "here").iterdir()) == []
    for out, wanted in (("out=tables", FILES), ("out=tables/own.csv", FILES | {"own.csv"})):
        monkeypatch.chdir(tmp_path / "here")
        assert nerf("table", tmp_path / "runs", out).code == 0
        assert {path.name for path in (tmp_path / "here" / "tables").iterdir()} == wanted


@pytest.mark.skipif(sys.platform == "win32", reason="symbolic links need rights there")
@pytest.mark.parametrize("name", [".table.{}.part.csv", ".table.{}.part.md", ".{}.probe", "table.md", "table.html"])
def test_planted_links_are_not_written_through(nerf, tmp_path, name):
    victims = [tmp_path / "precious", tmp_path / "not_there"]
    victims[0].write_text("precious")
    for victim in victims:
        runs = tmp_path / f"runs_{victim.name}"
        leave_measured_run(runs / "a")
        (runs / name.format(os.getpid())).symlink_to(victim)
        result = nerf("table", runs, f"out={runs}")
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
