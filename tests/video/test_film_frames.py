"""Frames on the disk: a stopped film goes on, another one begins anew, and nothing is lost when the disk is full."""

import errno
import json
import sys
from contextlib import suppress
from functools import partial

import numpy as np
import pytest
import torch
from filelock import FileLock
from support.running import refused

from nerf_lightning.files.made_folders import MARK
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.render_image import Picture
from nerf_lightning.video.frames import FilmFrames
from nerf_lightning.video.panels import film_pictures, panel
from nerf_lightning.visualization.pictures import letter_size, save_png

PICTURE = torch.full((8, 10, 3), 100, dtype=torch.uint8)
WRITE = partial(save_png, picture=PICTURE)


def frames(folder, form="video", films=("video", "depth")):
    return FilmFrames(folder, films, 4, form)


def opened(each, fingerprint="a", measured=(1.0, 2.0)):
    return each.open(fingerprint, lambda: measured)


def stop_after(folder, *numbers, form="video"):
    each = frames(folder, form)
    opened(each)
    for number in numbers:
        for film in each.films:
            each.save(film, number, WRITE)
    each.close()


def test_a_stopped_film_goes_on_with_what_is_missing_and_the_same_colours(tmp_path):
    stop_after(tmp_path, 0, 2)
    again = frames(tmp_path)
    missing, depths = opened(again, measured=(7.0, 9.0))
    assert (missing, depths) == ([1, 3], (1.0, 2.0))
    for number in missing:
        for film in again.films:
            again.save(film, number, WRITE)
    again.finish(fps=4)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["depth.mp4", "video.mp4"]
    assert again.results() == [tmp_path / "video.mp4", tmp_path / "depth.mp4"]


def test_another_film_begins_anew(tmp_path):
    stop_after(tmp_path, 0, 2)
    missing, depths = opened(frames(tmp_path), fingerprint="b", measured=(7.0, 9.0))
    assert (missing, depths) == ([0, 1, 2, 3], (7.0, 9.0))
    assert not list((tmp_path / ".frames").glob("*/*.png"))


def test_frames_that_are_the_result_are_replaced_by_another_films_and_else_kept(tmp_path):
    stop_after(tmp_path, 0, 1, 2, 3, form="frames")
    (tmp_path / "video" / "frame_0009.png").write_bytes(b"of a longer film")
    (tmp_path / "video" / "note.txt").write_text("mine")
    each = frames(tmp_path, "frames")
    assert opened(each)[0] == []
    each.finish(fps=4)
    assert (tmp_path / "video" / "frame_0003.png").is_file()
    assert opened(frames(tmp_path, "frames"), fingerprint="b")[0] == [0, 1, 2, 3]
    assert {file.name for file in (tmp_path / "video").iterdir()} == {"note.txt", MARK}


@pytest.mark.parametrize("note", ["", "[]", '{"fingerprint": "a", "depth_range": [1]}'])
def test_a_note_that_says_nothing_is_not_believed(tmp_path, note):
    stop_after(tmp_path, 0, 1)
    (tmp_path / ".frames" / "film.json").write_text(note)
    assert opened(frames(tmp_path))[0] == [0, 1, 2, 3]
    assert json.loads((tmp_path / ".frames" / "film.json").read_text())["depth_range"] == [1.0, 2.0]


def full(*arguments, **options):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_is_said_in_one_paragraph_and_the_frames_are_kept(tmp_path):
    stop_after(tmp_path, 0, 1)
    each = frames(tmp_path)
    opened(each)
    with pytest.raises(
        InputError, match=r"No space left.*2 of 4 frames are kept in .*same command again to render the missing"
    ) as said:
        each.save("video", 2, full)
    assert "\n" not in str(said.value)
    each.close()
    assert opened(frames(tmp_path))[0] == [2, 3]


def test_a_frame_that_cannot_be_read_is_named(tmp_path):
    stop_after(tmp_path, 0, 1, 2, 3)
    (tmp_path / ".frames" / "video" / "frame_0002.png").write_bytes(b"no picture")
    each = frames(tmp_path)
    opened(each)
    with pytest.raises(InputError, match=r"frame_0002.png cannot be read. Remove it.*the same command"):
        each.finish(fps=4)
    assert not list(tmp_path.glob("*.mp4"))
    each.close()


def test_two_processes_do_not_film_into_one_folder(tmp_path):
    (tmp_path / ".frames").mkdir()
    with FileLock(tmp_path / ".frames" / "lock"), pytest.raises(InputError, match="in use by another process"):
        opened(frames(tmp_path))


def test_what_is_not_ours_is_neither_emptied_nor_filled(tmp_path):
    for theirs in (".frames/film.json", ".frames/chapters/1.tex", "other/video/frame_0000.png"):
        (tmp_path / theirs).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / theirs).write_text("{}")
    for form in ("video", "frames"):
        refused(opened, frames(tmp_path, form), parts=(f"{tmp_path}/.frames", "not made by this program", "chapters"))
    assert (tmp_path / ".frames" / "chapters" / "1.tex").is_file()
    other = tmp_path / "other"
    refused(opened, frames(other, "frames"), parts=(f"{other}/video", "not made by this program", "frame_0000"))
    assert (other / "video" / "frame_0000.png").read_text() == "{}"


@pytest.mark.skipif(sys.platform == "win32", reason="symbolic links need rights there")
@pytest.mark.parametrize("link", [".frames", "video", ".frames/video", ".frames/lock", ".frames/film.json"])
def test_frames_go_through_no_link(tmp_path, link):
    """One that leads to another place in the same folder, too."""
    mine = tmp_path / "mine"
    (mine / "chapters").mkdir(parents=True)
    (mine / "frame_0000.png").write_text("mine")
    (mine / "1.tex").write_text("mine")
    stop_after(tmp_path, 0)
    if (tmp_path / link).is_dir():
        (tmp_path / link).rename(tmp_path / "away")
    (tmp_path / link).unlink(missing_ok=True)
    (tmp_path / link).symlink_to(mine / "1.tex" if "." in link[2:] or "lock" in link else mine)
    for form in ("video", "frames"):
        each = frames(tmp_path, form)
        with suppress(InputError):
            opened(each, fingerprint="b")
            each.save("video", 0, WRITE)
        each.close()
    assert {path.name for path in mine.iterdir()} == {"chapters", "frame_0000.png", "1.tex"}
    assert (mine / "1.tex").read_text() == (mine / "frame_0000.png").read_text() == "mine"


RGB = torch.linspace(0, 1, 20 * 30 * 3).view(20, 30, 3)
OPACITY = torch.ones(20, 30).index_fill(1, torch.arange(15), 0.0)
SEEN = Picture(RGB, torch.full((20, 30), 2.0), OPACITY, first_rgb=RGB.flip(0))


def shown(output, normals=None):
    return panel(output, SEEN, (1.0, 3.0), 1.0, normals)


def test_each_output_shows_what_it_says_and_depth_is_told_in_the_users_units():
    assert torch.equal(shown("rgb"), (RGB * 255).round().to(torch.uint8))
    assert shown("opacity")[0, 0].tolist() == [0, 0, 0]
    assert shown("opacity")[0, 29].tolist() == [255, 255, 255]
    up = torch.tensor([0.0, 0.0, 1.0]).expand(20, 30, 3)
    assert shown("normals", up)[0, 29].tolist() == [128, 128, 255]
    left = shown("normals", up)[0, 0].tolist()
    assert left == [left[0]] * 3, "gray where nothing is"
    same = panel("levels", Picture(RGB, SEEN.depth, OPACITY, first_rgb=RGB), (1.0, 3.0), 1.0, None)
    assert len(same[:, :30].reshape(-1, 3).unique(dim=0)) == 1
    assert len(shown("levels")[:, :30].reshape(-1, 3).unique(dim=0)) > 1
    near = panel("depth", SEEN, (4.0, 6.0), 2.0, None)  # 2 scene units are 4 of the user's: as near as can be
    far = panel("depth", SEEN, (2.0, 4.0), 2.0, None)
    assert int(near[0, 29].sum()) > 600 > 100 > int(far[0, 29].sum())


def test_several_models_stand_side_by_side_under_their_names_or_in_rows_of_a_mosaic():
    panels = [{"rgb": shown("rgb")}, {"rgb": shown("rgb").flip(0)}]
    film = film_pictures(panels, ["a", "b"], mosaic=False)["video"]
    size = letter_size(20)
    top, edge = size // 2 + round(1.5 * size), size // 2
    assert torch.equal(film[top : top + 20, edge : edge + 30], shown("rgb"))
    assert torch.equal(film[top : top + 20, edge + 30 + size : edge + 60 + size], shown("rgb").flip(0))
    other = film_pictures(panels, ["a", "other"], mosaic=False)["video"]
    assert not np.array_equal(film[:top], other[:top])
    panels = [{"rgb": shown("rgb"), "depth": shown("depth"), "opacity": shown("opacity")}] * 2
    one, two = film_pictures(panels[:1], ["a"], mosaic=True), film_pictures(panels, ["a", "b"], mosaic=True)
    assert list(one) == list(two) == ["mosaic"]
    assert one["mosaic"].shape[1] > 3 * 30
    assert two["mosaic"].shape[0] > 2 * (one["mosaic"].shape[0] - 2 * letter_size(20))
