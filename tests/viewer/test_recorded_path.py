"""Keyframes of the page mean to `nerf render` what they looked like."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.scenes import ball_scene

from nerf_lightning.checkpoints.reading import scene_record
from nerf_lightning.nerf.geometry.frames import points_from_user, similarity, upright_rotation
from nerf_lightning.video.paths.keyframes import read_keyframes
from nerf_lightning.viewer import limits
from nerf_lightning.viewer.client import ViewerClient
from nerf_lightning.viewer.recorded_path import RecordedPath

EYES = ([4.0, 0.0, 1.0], [0.0, 4.0, 2.0])


class FakeSession(ViewerClient):
    def __init__(self, client, record):
        self.client, self.photographs = client, SimpleNamespace(record=record)

    def pose(self):
        return torch.eye(4)[:3]


@pytest.fixture
def record():
    rotation = upright_rotation(torch.nn.functional.normalize(torch.tensor([0.3, 1.0, 0.2]), dim=0))
    to_user = similarity(rotation, torch.tensor([5.0, -2.0, 1.0]), 2.5)
    return replace(scene_record(ball_scene()), to_user=to_user)


@pytest.fixture
def session(record):
    camera = SimpleNamespace(
        position=np.array(EYES[0]),
        look_at=np.zeros(3),
        up_direction=np.array([0.0, 0.0, 1.0]),
        fov=0.7,
        aspect=2.0,
    )
    return FakeSession(SimpleNamespace(camera=camera), record)


def test_a_recorded_path_is_read_back_in_the_models_frame(session, record, tmp_path):
    drawn = []
    path = RecordedPath(
        session, tmp_path / "new", lambda *what: drawn.append(what) or SimpleNamespace(remove=drawn.pop)
    )
    assert path.save() == "A path needs two keyframes or more."
    for eye in (EYES[0], EYES[1], EYES[0]):
        session.client.camera.position = np.array(eye)
        said = path.add(1.5)
    assert said == "3 keyframes, 3.0 s"
    assert path.remove_last() == "2 keyframes, 1.5 s"
    assert len(drawn) == 2
    path.save()
    (file,) = (tmp_path / "new").glob("*.yaml")
    frames = read_keyframes(file)
    back = points_from_user(torch.tensor([frame.position for frame in frames]).double(), record.to_user.double())
    assert torch.allclose(back, torch.tensor(EYES).double(), atol=1e-5)
    looked_at = points_from_user(torch.tensor([frames[1].look_at]).double(), record.to_user.double())
    assert torch.allclose(looked_at, torch.zeros(1, 3).double(), atol=1e-5)
    assert [frame.time for frame in frames] == [0.0, 1.5]
    assert frames[0].fov == pytest.approx(np.degrees(0.7), abs=1e-3)  # square photographs


def test_a_place_that_cannot_be_written_is_said(session, tmp_path):
    (tmp_path / "file").write_text("")
    path = RecordedPath(session, tmp_path / "file", lambda *_: None)
    path.add(1.0)
    path.add(1.0)
    assert "It could not be saved: [Errno 17] File exists" in path.save()


def test_files_are_never_overwritten(session, tmp_path):
    path = RecordedPath(session, tmp_path, lambda *_: None)
    path.add(1.0)
    path.add(1.0)
    path.save()
    path.save()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["camera_path_001.yaml", "camera_path_002.yaml"]


def test_keyframes_and_files_are_limited_and_it_is_said(session, tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "MOST_KEYFRAMES", 2)
    monkeypatch.setattr(limits, "MOST_PATHS", 1)
    path = RecordedPath(session, tmp_path, lambda *_: None)
    said = [path.add(seconds) for seconds in (1.0, 1e12, 1.0)]
    assert said[1:] == [
        f"2 keyframes, {limits.MOST_SECONDS_BETWEEN:.1f} s",
        "A path has 2 keyframes at most. Save it, then remove some.",
    ]
    assert path.save().startswith("Saved")
    assert "holds 1 of them, the most that the page writes" in path.save()
    assert len(list(tmp_path.iterdir())) == 1


def test_a_folders_name_is_no_markup(session, tmp_path):
    folder = tmp_path / "<script>"
    path = RecordedPath(session, folder, lambda *_: None)
    path.add(1.0)
    path.add(1.0)
    assert path.save().endswith(f"`path=keyframes path.file={folder}/camera_path_001.yaml`")
