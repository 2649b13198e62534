"""Names of files that are written again and again: each is one writer's."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from nerf_lightning.viewer.recorded_path import free_name


def test_two_that_save_at_once_have_two_names(tmp_path):
    with free_name(tmp_path / "new", "a", ".txt", 5) as first, free_name(tmp_path / "new", "a", ".txt", 5) as second:
        first.write_text("1")
        second.write_text("2")
    assert {file.name: file.read_text() for file in (tmp_path / "new").iterdir()} == {
        "a_001.txt": "1",
        "a_002.txt": "2",
    }


def test_many_that_save_at_once_lose_nothing(tmp_path):
    def save(number):
        with free_name(tmp_path, "a", ".txt", 100) as path:
            path.write_text(str(number))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(save, range(100)))
    assert sorted(int(file.read_text()) for file in tmp_path.iterdir()) == list(range(100))


def test_what_could_not_be_written_gives_its_name_back(tmp_path):
    with pytest.raises(OSError, match="full"):
        save_half(tmp_path)
    assert not list(tmp_path.iterdir())
    with free_name(tmp_path, "a", ".txt", 1) as path:
        path.write_text("whole")
    with pytest.raises(OSError, match="holds 1 of them"), free_name(tmp_path, "a", ".txt", 1):
        pass
    assert path.read_text() == "whole"


def save_half(folder):
    with free_name(folder, "a", ".txt", 1) as path:
        path.write_text("half")
        raise OSError("full")


def test_a_link_is_not_written_through(tmp_path):
    (tmp_path / "a_001.txt").symlink_to(tmp_path / "elsewhere")
    with free_name(tmp_path, "a", ".txt", 5) as path:
        assert path.name == "a_002.txt"
