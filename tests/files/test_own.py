"""What is kept is believed only where nobody but the user can have written it."""

import logging
import os
from pathlib import Path

import numba
import pytest
import torch
from support.malformed import WRITERS
from support.posed_captures import read

from nerf_lightning.data.bricks.reader import BricksReader
from nerf_lightning.files.made_folders import make_own_folder
from nerf_lightning.files.regular import open_own
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.kernels import backends

pytestmark = pytest.mark.skipif(os.name != "posix", reason="owners and modes are posix's")


@pytest.fixture(params=[0o022, 0o000])
def umask(request):
    former = os.umask(request.param)
    yield
    os.umask(former)


def mode(path):
    return path.stat().st_mode & 0o777


def belongs_to_another(path, monkeypatch):
    """Let it look as a stranger's; giving it away takes a superuser."""
    monkeypatch.setattr(os, "geteuid", lambda: path.stat().st_uid + 1)


def test_folders_are_made_for_the_user_alone(tmp_path, umask):
    make_own_folder(tmp_path / "a" / "b")
    assert mode(tmp_path / "a") == mode(tmp_path / "a" / "b") == 0o700


@pytest.mark.parametrize("shared", [0o777, 0o770, 0o1777, 0o702])
def test_a_folder_that_others_can_write_to_is_refused(tmp_path, shared):
    (tmp_path / "a").mkdir()
    (tmp_path / "a").chmod(shared)
    with pytest.raises(
        InputError, match=rf"a can be written by others \(mode 0?{shared:o}\).*\(chmod 700 .*a'\); otherwise"
    ):
        make_own_folder(tmp_path / "a")
    (tmp_path / "a").chmod(0o755)
    make_own_folder(tmp_path / "a")


def test_a_strangers_folder_is_refused(tmp_path, monkeypatch):
    belongs_to_another(tmp_path, monkeypatch)
    with pytest.raises(InputError, match=r"belongs to another user \(number \d+\)"):
        make_own_folder(tmp_path)


def test_files_of_others_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "it"
    path.write_bytes(b"content")
    (tmp_path / "link").symlink_to(path)
    with open_own(path, 100) as file:
        assert file.read() == b"content"
    with pytest.raises(InputError, match=r"link is a symbolic link"):
        open_own(tmp_path / "link", 100)
    path.chmod(0o666)
    with pytest.raises(
        InputError, match=r"it can be written by others \(mode 0666\), so it may come from somebody else"
    ):
        open_own(path, 100)
    path.chmod(0o600)
    belongs_to_another(path, monkeypatch)
    with pytest.raises(InputError, match=r"it belongs to another user"):
        open_own(path, 100)


def bricks(folder):
    return BricksReader(resolution=8, num_train=1, num_val=0, num_test=0, cache_dir=str(folder)).read().pixels.rgba


def test_kept_photographs_are_the_users_own(tmp_path, umask, caplog):
    root, cache = WRITERS["llff"](tmp_path / "capture"), tmp_path / "cache"
    first = read("llff", root).pixels.rgba.clone()
    assert mode(cache) == 0o700
    for ending in (".json", ".pixels"):
        (path,) = cache.glob(f"*{ending}")
        assert mode(path) == 0o600
        inode = path.stat().st_ino
        read("llff", root)
        assert path.stat().st_ino == inode
        path.chmod(0o620)
        caplog.clear()
        assert torch.equal(read("llff", root).pixels.rgba, first)
        assert mode(path) == 0o600
        assert "can be written by others (mode 0620)" in caplog.text


def test_numba_reads_no_programs_from_a_folder_of_others(tmp_path, monkeypatch, caplog):
    backends._cache_elsewhere.cache_clear()
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "own"))
    backends._configure_numba()
    assert str(tmp_path / "own") == numba.config.CACHE_DIR
    assert mode(tmp_path / "own") == 0o700
    (tmp_path / "own").chmod(0o777)
    with caplog.at_level(logging.WARNING):
        backends._configure_numba()
    assert str(tmp_path / "own") != numba.config.CACHE_DIR
    assert mode(Path(numba.config.CACHE_DIR)) == 0o700
    assert "can be written by others (mode 0777)" in caplog.text
    assert "own with NUMBA_CACHE_DIR." in caplog.text
    backends._cache_elsewhere.cache_clear()
