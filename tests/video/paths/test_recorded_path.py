"""Keyframes of the page mean to `nerf render` what they looked like, and those of others can be read."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import vertical_field_of_view
from nerf_lightning.nerf.geometry.world_frame import points_from_user, similarity, upright_rotation
from nerf_lightning.video.paths.base import frame_of
from nerf_lightning.video.paths.keyframe_path import KeyframePath
from nerf_lightning.video.paths.keyframes import Keyframe, read_keyframes
from nerf_lightning.video.paths.recorded_path import RecordedPath, keyframe_of, new_file

EYES = torch.tensor([[4.0, 0.0, 1.0], [0.0, 4.0, 2.0], [-4.0, 0.0, 1.0]])
ROTATION = upright_rotation(torch.nn.functional.normalize(torch.tensor([0.3, 1.0, 0.2]), dim=0))
TO_USER = similarity(ROTATION, torch.tensor([5.0, -2.0, 1.0]), 2.5)


@pytest.fixture
def path(tmp_path):
    record = replace(scene_record(ball_scene()), to_user=TO_USER)
    return RecordedPath(frame_of(record.cameras, record.aabb, to_user=record.to_user), tmp_path / "viewer")


@pytest.fixture
def filled(path):
    for number, eye in enumerate(EYES):
        path.insert(number, keyframe_of(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]), 0.7, path.around))
    return path


def test_a_saved_path_is_read_back_in_the_models_frame(filled):
    filled.legs[1] = 1.5
    frames = read_keyframes(filled.save())
    back = points_from_user(torch.tensor([frame.position for frame in frames]).double(), TO_USER.double())
    assert torch.allclose(back, EYES.double(), atol=1e-5)
    looked_at = points_from_user(torch.tensor([frames[1].look_at]).double(), TO_USER.double())
    assert torch.allclose(looked_at, torch.zeros(1, 3).double(), atol=1e-5)
    assert [frame.time for frame in frames] == [0.0, 1.5, 3.5]
    assert frames[0].fov == pytest.approx(np.degrees(0.7), abs=1e-3)  # square photographs


def test_what_the_page_plays_is_what_a_film_shows(filled):
    filled.legs[2] = 0.7
    film = KeyframePath(str(filled.save()), fps=10).cameras(filled.around)
    curve = filled.curve()
    for frame in (0, 5, 20, 25, 27):
        c2w, fov = filled.view_at(curve, frame / 10)
        assert torch.allclose(c2w, film.c2w[frame], atol=1e-4)
        assert vertical_field_of_view(film, frame) == pytest.approx(fov, abs=1e-4)


def test_a_file_that_was_written_by_hand_is_loaded_with_all_that_it_says(path):
    path.folder.mkdir()
    (path.folder / "mine.yaml").write_text(
        "- {position: [4, 0, 1], look_at: [0, 0, 0], fov: 30}\n"
        "- {position: [0, 4, 2], look_at: [0, 0, 0.5], up: [0, 0.1, 1]}\n"
        "- {position: [-4, 0, 1], look_at: [0, 0, 0.5], fov: 40}\n"
    )
    path.load("mine.yaml")
    assert path.times[-1] == pytest.approx(4.0)  # none are given: at about one speed
    assert [each.fov for each in path.keyframes] == [30, None, 40]
    film = KeyframePath(str(path.folder / "mine.yaml"), num_frames=3).cameras(path.around)
    assert torch.allclose(path.view_at(path.curve(), 2.0)[0], film.c2w[1], atol=1e-4)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("- {position: [0, 0, 1], look_at: [0, 0, 0]}\n", "has 1 keyframe"),
        ("- {position: [0, 0, 1], look_at: [0, 0, 2], up: [0, 0, 2]}\n" * 2, "looks straight along its up"),
    ],
)
def test_a_file_that_is_no_path_is_refused_and_the_path_stays(filled, text, why):
    filled.folder.mkdir()
    (filled.folder / "mine.yaml").write_text(text)
    before = list(filled.keyframes)
    with pytest.raises(InputError, match=why):
        filled.load("mine.yaml")
    assert filled.keyframes == before


def test_only_plain_files_of_the_folder_are_loaded(filled, tmp_path):
    (tmp_path / "secret.yaml").write_text("- {position: [0, 0, 1], look_at: [0, 0, 0]}\n" * 2)
    filled.save()
    (filled.folder / "link.yaml").symlink_to(tmp_path / "secret.yaml")
    (filled.folder / "note.txt").write_text("")
    assert filled.files() == ["camera_path_001.yaml"]
    for name in ("../secret.yaml", "link.yaml", str(tmp_path / "secret.yaml"), "note.txt", ""):
        with pytest.raises(InputError, match="no keyframe file of this name"):
            filled.load(name)


def test_a_camera_whose_picture_has_no_top_is_refused_and_without_its_first_keyframe_a_path_begins_at_the_next(filled):
    with pytest.raises(InputError, match="looks straight along its up"):
        filled.insert(1, Keyframe((0.0, 0.0, 5.0), look_at=(0.0, 0.0, 4.0), up=(0.0, 0.0, 1.0)))
    assert len(filled.keyframes) == len(filled.legs) == 3
    filled.legs[1:] = [1.0, 3.0]
    filled.remove(0)
    assert filled.times == [0.0, 3.0]
    filled.remove(0)
    assert filled.times == [0.0]
    assert filled.curve() is None


def test_new_files_take_no_name_twice_follow_no_link_and_give_their_name_back_on_failure(tmp_path):
    (tmp_path / "a_002.txt").symlink_to(tmp_path / "elsewhere")

    def save(number):
        with new_file(tmp_path, "a", ".txt") as path:
            path.write_text(str(number))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(save, range(100)))
    assert sorted(int(file.read_text()) for file in tmp_path.iterdir() if not file.is_symlink()) == list(range(100))
    assert not (tmp_path / "elsewhere").exists()
    with pytest.raises(FileNotFoundError), new_file(tmp_path / "new", "a", ".txt") as path:
        path.with_name("other").rename(path)
    assert list((tmp_path / "new").iterdir()) == []
