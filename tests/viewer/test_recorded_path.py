"""Keyframes of the page mean to `nerf render` what they looked like, and those of others can be read and changed."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.checkpoints.reading import scene_record
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import vertical_field_of_view
from nerf_lightning.nerf.geometry.frames import points_from_user, similarity, upright_rotation
from nerf_lightning.video.paths.base import frame_of
from nerf_lightning.video.paths.keyframe_path import KeyframePath
from nerf_lightning.video.paths.keyframes import Keyframe, read_keyframes
from nerf_lightning.viewer import limits
from nerf_lightning.viewer.recorded_path import RecordedPath, keyframe_in_user_frame

EYES = torch.tensor([[4.0, 0.0, 1.0], [0.0, 4.0, 2.0], [-4.0, 0.0, 1.0]])


@pytest.fixture
def record():
    rotation = upright_rotation(torch.nn.functional.normalize(torch.tensor([0.3, 1.0, 0.2]), dim=0))
    to_user = similarity(rotation, torch.tensor([5.0, -2.0, 1.0]), 2.5)
    return replace(scene_record(ball_scene()), to_user=to_user)


@pytest.fixture
def path(record, tmp_path):
    return RecordedPath(frame_of(record.cameras, record.aabb, to_user=record.to_user), tmp_path / "viewer")


@pytest.fixture
def keys(record):
    up = torch.tensor([0.0, 0.0, 1.0])
    return [keyframe_in_user_frame(eye, torch.zeros(3), up, 0.7, record) for eye in EYES]


@pytest.fixture
def filled(path, keys):
    for number, each in enumerate(keys):
        path.insert(number, each)
    return path


def test_a_saved_path_is_read_back_in_the_models_frame(filled, record):
    filled.set_leg(1, 1.5)
    frames = read_keyframes(filled.save())
    back = points_from_user(torch.tensor([frame.position for frame in frames]).double(), record.to_user.double())
    assert torch.allclose(back, EYES.double(), atol=1e-5)
    looked_at = points_from_user(torch.tensor([frames[1].look_at]).double(), record.to_user.double())
    assert torch.allclose(looked_at, torch.zeros(1, 3).double(), atol=1e-5)
    assert [frame.time for frame in frames] == [0.0, 1.5, 3.5]
    assert frames[0].fov == pytest.approx(np.degrees(0.7), abs=1e-3)  # square photographs


def test_what_the_page_plays_is_what_a_film_shows(filled, record):
    filled.set_leg(2, 0.7)
    film = KeyframePath(str(filled.save()), fps=10).cameras(filled.around)
    curve = filled.curve()
    for frame in (0, 5, 20, 25, 27):
        c2w, fov = filled.view_at(curve, frame / 10)
        assert torch.allclose(c2w, film.c2w[frame], atol=1e-4)
        assert vertical_field_of_view(film, frame) == pytest.approx(fov, abs=1e-4)


def test_keyframes_are_moved_changed_and_deleted_and_their_times_stay_in_order(filled, keys):
    filled.set_leg(1, 1.0)
    assert filled.move(0, 1) == 1
    assert filled.move(2, 1) == 2
    assert filled.keyframes == [keys[1], keys[0], keys[2]]
    assert filled.times == [0.0, 1.0, 3.0]
    filled.change(0, keys[2])
    filled.remove(1)
    assert filled.keyframes == [keys[2], keys[2]]
    assert filled.times == [0.0, 2.0]
    filled.remove(0)
    assert (filled.keyframes, filled.times) == ([keys[2]], [0.0])


def test_a_file_that_was_written_by_hand_is_loaded_with_all_that_it_says(path, record):
    path.folder.mkdir()
    (path.folder / "mine.yaml").write_text(
        "- {position: [4, 0, 1], direction: [-4, 0, -1], focal: 30}\n"
        "- {position: [0, 4, 2], look_at: [0, 0, 0.5], up: [0, 0.1, 1]}\n"
        "- {position: [-4, 0, 1], look_at: [0, 0, 0.5], fov: 40}\n"
    )
    path.load("mine.yaml")
    assert path.seconds == pytest.approx(4.0)  # none are given: at about one speed
    assert [each.focal for each in path.keyframes] == [30, None, None]
    film = KeyframePath(str(path.folder / "mine.yaml"), num_frames=3).cameras(path.around)
    assert torch.allclose(path.view_at(path.curve(), 2.0)[0], film.c2w[1], atol=1e-4)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("- {position: [0, 0, 1]}\n", "must have a position, and one of look_at and direction"),
        ("- {position: [0, 0, 1], look_at: [0, 0, 0]}\n", "has 1 keyframe"),
        ("{", "mine.yaml"),
        ("- {position: [0, 0, 1], direction: [0, 0, 1], up: [0, 0, 2]}\n" * 2, "looks straight along its up"),
        ("- {position: [0, 0, 9000000000.0], direction: [0, 1, 0], up: [0, 0, 2]}\n" * 2, "too far away"),
    ],
)
def test_a_file_that_is_no_path_is_refused_and_the_path_stays(filled, keys, text, why):
    filled.folder.mkdir()
    (filled.folder / "mine.yaml").write_text(text)
    with pytest.raises(InputError, match=why):
        filled.load("mine.yaml")
    assert filled.keyframes == keys


def test_only_plain_files_of_the_folder_are_loaded(filled, tmp_path):
    (tmp_path / "secret.yaml").write_text("- {position: [0, 0, 1], look_at: [0, 0, 0]}\n" * 2)
    filled.save()
    (filled.folder / "link.yaml").symlink_to(tmp_path / "secret.yaml")
    (filled.folder / "note.txt").write_text("")
    assert filled.files() == ["camera_path_001.yaml"]
    for name in ("../secret.yaml", "link.yaml", str(tmp_path / "secret.yaml"), "note.txt", ""):
        with pytest.raises(InputError, match="no keyframe file of this name"):
            filled.load(name)


def test_a_place_that_cannot_be_written_is_an_error(filled):
    filled.folder.write_text("")
    with pytest.raises(OSError, match="File exists"):
        filled.save()
    assert filled.files() == []


def test_one_keyframe_is_no_path_and_leaves_no_file(path, keys):
    path.insert(0, keys[0])
    with pytest.raises(InputError, match="two keyframes or more"):
        path.save()
    assert path.files() == []
    assert path.curve() is None


def test_files_are_never_overwritten_and_limited(filled, monkeypatch):
    monkeypatch.setattr(limits, "MOST_PATHS", 2)
    filled.save()
    filled.save()
    assert sorted(file.name for file in filled.folder.iterdir()) == ["camera_path_001.yaml", "camera_path_002.yaml"]
    with pytest.raises(OSError, match="holds 2 of them, the most that the page writes"):
        filled.save()


def test_keyframes_and_times_are_limited(filled, keys, monkeypatch):
    monkeypatch.setattr(limits, "MOST_KEYFRAMES", 3)
    with pytest.raises(InputError, match="3 keyframes at most"):
        filled.insert(0, keys[0])
    filled.set_leg(1, 1e12)
    filled.set_leg(2, -1.0)
    assert filled.legs == [0.0, limits.MOST_SECONDS_BETWEEN, 0.1]


def test_a_camera_whose_picture_has_no_top_is_refused(filled, keys):
    with pytest.raises(InputError, match="looks straight along its up"):
        filled.insert(1, Keyframe((0.0, 0.0, 5.0), direction=(0.0, 0.0, -1.0), up=(0.0, 0.0, 1.0)))
    assert filled.keyframes == keys
