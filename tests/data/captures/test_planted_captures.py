"""Captures from strangers: nothing outside their folder is read, and nothing in them is larger than it looks."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.budget import budget
from support.captures import write_blender, write_npz
from support.malformed import WRITERS, edit_bytes, edit_frame
from support.planted import Payload
from support.posed_captures import read

from nerf_lightning.data.bricks.cache import cached
from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.data.readers.npz import NpzReader
from nerf_lightning.data.sfm.photograph_folder import find_photographs
from nerf_lightning.data.sfm.video_frames import count_frames
from nerf_lightning.files.atomic import MACHINE
from nerf_lightning.messages.errors import InputError

OUT = r"leads out of the capture's folder.*scene.allow_outside=true"
NAMES = {"llff": "llff", "colmap": "colmap", "text": "colmap", "transforms": "transforms"}


@pytest.fixture
def secret(tmp_path):
    """A picture, and what else a capture would like to read, beside the capture's folder."""
    (tmp_path / "secret").mkdir()
    Image.fromarray(np.full((12, 16, 3), 200, np.uint8)).save(tmp_path / "secret" / "p_3.png")
    return tmp_path / "secret"


def left_out_until_allowed(kind, root, caplog, message=OUT):
    scene = read(NAMES[kind], root)
    assert len(scene.view_names) == 8
    assert not bool((scene.pixels.rgba[:, :3] == 200).all(dim=-1).any())
    assert re.search(message, caplog.text)
    assert len(read(NAMES[kind], root, allow_outside=True).view_names) == 9


OWN_FILES = {
    "llff": ("poses_bounds.npy",),
    "colmap": ("sparse", "sparse/0", "sparse/0/images.bin"),
    "text": ("sparse/0/cameras.txt",),
    "transforms": ("transforms.json",),
}


@pytest.mark.parametrize(
    ("kind", "place"), [(kind, place) for kind in WRITERS for place in ("images", "images/p_3.png", *OWN_FILES[kind])]
)
def test_links_out_of_a_capture_are_followed_for_reading(tmp_path, secret, kind, place):
    root = WRITERS[kind](tmp_path / "capture")
    before = read(NAMES[kind], root).pixels.rgba
    (secret / "p_3.png").unlink()
    (root / place).rename(secret / Path(place).name)
    (root / place).symlink_to(secret / Path(place).name)
    assert bool((read(NAMES[kind], root).pixels.rgba == before).all())


@pytest.mark.parametrize("kind", WRITERS)
def test_a_capture_that_is_a_link_itself_and_links_inside_of_it(tmp_path, kind):
    root = WRITERS[kind](tmp_path / "capture")
    (root / "images").rename(root / "photos")
    (root / "images").symlink_to("photos")
    (tmp_path / "link").symlink_to(root)
    assert len(read(NAMES[kind], tmp_path / "link").view_names) == 9


def test_a_folder_of_photographs_that_the_user_names(tmp_path, secret):
    root = WRITERS["colmap"](tmp_path / "capture")
    (root / "images").rename(secret / "images")
    for name in ("../secret/images", str(secret / "images")):
        assert len(read("colmap", root, images=name).view_names) == 9


@pytest.mark.parametrize("name", ["images/../../secret/p_3", "..\\secret\\p_3.png", "ABSOLUTE"])
def test_paths_out_of_a_transforms_file(tmp_path, secret, caplog, name):
    root = WRITERS["transforms"](tmp_path / "capture")
    (root / "images" / "p_3.png").unlink()
    edit_frame(root, 3, file_path=name.replace("ABSOLUTE", str(secret / "p_3.png")))
    left_out_until_allowed("transforms", root, caplog)


@pytest.mark.parametrize("name", ["../secret/p_3.png", "ABSOLUTE"])
def test_masks_out_of_a_capture(tmp_path, secret, caplog, name):
    root = WRITERS["transforms"](tmp_path / "capture")
    edit_frame(root, 3, mask_path=name.replace("ABSOLUTE", str(secret / "p_3.png")))
    assert read("transforms", root).pixels.mask is None
    assert "of 1 files (mask_path) 1 are missing" in caplog.text
    assert read("transforms", root, allow_outside=True).pixels.mask is not None


def test_masks_may_lie_in_a_folder_that_the_user_names(tmp_path, secret):
    root = WRITERS["colmap"](tmp_path / "capture")
    (secret / "masks").mkdir()
    for view in range(9):
        Image.fromarray(np.full((12, 16), 255, np.uint8)).save(secret / "masks" / f"p_{view}.png")
    assert read("colmap", root, masks="../secret/masks").pixels.mask is not None


@pytest.mark.parametrize("name", ["../../secret/p_3.png", "ABSOLUTE"])
@pytest.mark.parametrize("kind", ["colmap", "text"])
def test_names_out_of_a_colmap_model(tmp_path, secret, caplog, kind, name):
    root = WRITERS[kind](tmp_path / "capture")
    (root / "images" / "p_3.png").unlink()
    name = name.replace("ABSOLUTE", str(secret / "p_3.png"))
    edit_bytes(root, "images.bin" if kind == "colmap" else "images.txt", b"p_3.png", name.encode())
    left_out_until_allowed(kind, root, caplog)


@pytest.mark.parametrize("name", ["../secret/p_3", "ABSOLUTE"])
def test_paths_out_of_a_blender_file(tmp_path, secret, caplog, name):
    root = tmp_path / "capture"
    write_blender(root, {"train": 9, "val": 2, "test": 2}, width=16, height=12)
    path = root / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"][3]["file_path"] = name.replace("ABSOLUTE", str(secret / "p_3"))
    path.write_text(json.dumps(content))
    assert len(BlenderReader(str(root)).read().view_names) == 12
    assert re.search(OUT, caplog.text)
    assert len(BlenderReader(str(root), allow_outside=True).read().view_names) == 13


def test_links_in_a_folder_of_photographs(tmp_path, secret):
    folder = tmp_path / "photos"
    folder.mkdir()
    for view in range(3):
        Image.fromarray(np.zeros((80, 90, 3), np.uint8)).save(folder / f"{view}.png")
    Image.fromarray(np.zeros((80, 90, 3), np.uint8)).save(secret / "mine.png")
    (folder / "3.png").symlink_to(secret / "mine.png")
    assert len(find_photographs(folder)) == 4
    (tmp_path / "link").symlink_to(folder)
    (folder / "3.png").unlink()
    assert len(find_photographs(tmp_path / "link")) == 3


@pytest.mark.parametrize(
    "text",
    [
        "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile:///etc/passwd\n#EXT-X-ENDLIST\n",
        "ffconcat version 1.0\nfile /etc/passwd\n",
        "v=0\no=- 0 0 IN IP4 127.0.0.1\n",
        "<?xml version='1.0'?><MPD><BaseURL>file:///etc/passwd</BaseURL></MPD>",
        "",
    ],
)
def test_playlists_that_are_called_videos(tmp_path, text):
    (tmp_path / "a.mp4").write_text(text)
    with pytest.raises(InputError, match=r"a.mp4 is not in a supported video format.*not followed"):
        count_frames(tmp_path / "a.mp4")


def test_pickles_in_arrays(tmp_path):
    mark = tmp_path / "ran"
    evil = np.array([Payload(open, str(mark), "w")], dtype=object)
    for key in ("images", "poses", "focal"):
        with pytest.raises(InputError, match=r"npz cannot be read \(ValueError: Object arrays cannot be"):
            NpzReader(str(write_npz(tmp_path / "a.npz", **{key: evil}))).read()
    root = WRITERS["llff"](tmp_path / "capture")
    np.save(root / "poses_bounds.npy", evil, allow_pickle=True)
    with pytest.raises(InputError, match="Object arrays cannot be loaded"):
        read("llff", root)
    np.savez(tmp_path / "cache.npz", rgba=evil, depth=evil, normals=evil)
    sound = np.zeros((1, 4), np.uint8)
    assert cached(tmp_path / "cache.npz", 1, lambda: sound) is sound
    assert not mark.exists()


def test_what_an_archive_may_unpack_to_is_a_setting(tmp_path):
    path = write_npz(tmp_path / "a.npz")
    for most in ({"npz_arrays": 2}, {"npz_bytes": 1000}):
        with budget(**most), pytest.raises(InputError, match=rf"a.npz has .* the limit .* budgets.{next(iter(most))}="):
            NpzReader(str(path)).read()
    assert NpzReader(str(path)).read().view_names


@pytest.fixture
def header(tmp_path):
    """What says what a file of kept pixels holds, of a capture that was read once."""
    read("colmap", WRITERS["colmap"](tmp_path / "capture"))
    (header,) = (tmp_path / "cache").glob("*.json")
    return header


@pytest.mark.parametrize(
    "change",
    [
        {"sizes": [[-16, -12]] * 9},
        {"sizes": [[2**40, 2**40]]},
        {"sizes": [[16.0, 12.0]] * 9},
        {"sizes": "x"},
        {"masked": "yes"},
        {"spots": None},
    ],
    ids=str,
)
def test_a_planted_cache_is_not_believed(tmp_path, header, change):
    before = read("colmap", tmp_path / "capture").pixels
    header.write_text(json.dumps(json.loads(header.read_text()) | change))
    pixels = read("colmap", tmp_path / "capture").pixels
    assert pixels.width.tolist() == before.width.tolist()
    assert bool((pixels.view(3) == before.view(3)).all())


def test_a_cache_of_other_photographs_is_refused(tmp_path, header):
    header.write_text(json.dumps(json.loads(header.read_text()) | {"sizes": [[144, 12]]}))
    with pytest.raises(InputError, match=r"holds 1 photographs instead of 9.*Remove"):
        read("colmap", tmp_path / "capture")


def test_links_in_the_place_of_a_lock_or_of_parts_are_not_followed(tmp_path, header):
    header.unlink()
    (tmp_path / "victim").write_text("precious")
    for ending in (".pixels", ".json"):
        part = f".{header.stem}.{os.getpid()}_{MACHINE}.nerf_lightning.part{ending}"
        header.with_name(part).symlink_to(tmp_path / "victim")
    assert len(read("colmap", tmp_path / "capture").view_names) == 9
    header.unlink()
    header.with_suffix(".lock").unlink(missing_ok=True)
    header.with_suffix(".lock").symlink_to(tmp_path / "victim")
    with pytest.raises(InputError, match="cannot be cached in"):
        read("colmap", tmp_path / "capture")
    assert (tmp_path / "victim").read_text() == "precious"
