"""Which camera path comes with a page."""

import os

from support.baked_ball import all_around, record_of
from support.running import refused

from nerf_lightning.commands.page_path import page_path
from nerf_lightning.video.paths.auto import AutoPath
from nerf_lightning.video.paths.keyframes import Keyframe, write_keyframes
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.paths.photograph_path import PhotographPath


def record(folder, name, age, x):
    folder.mkdir(exist_ok=True)
    places = (Keyframe((x + i, 0.0, 1.0), look_at=(0.0, 0.0, 0.0), time=float(i)) for i in range(2))
    write_keyframes(folder / name, list(places))
    os.utime(folder / name, (1e9 - age, 1e9 - age))


def test_what_was_recorded_last_is_played_unless_another_path_is_asked_for(tmp_path):
    scene = record_of(all_around())
    assert len(page_path(AutoPath(), scene, tmp_path)) == 25  # a circle
    record(tmp_path / "viewer", "camera_path_001.yaml", 20, 3.0)
    record(tmp_path / "viewer", "camera_path_002.yaml", 10, 5.0)
    assert [each["position"][0] for each in page_path(AutoPath(), scene, tmp_path)] == [5.0, 6.0]
    assert len(page_path(Orbit(), scene, tmp_path)) == 25


def test_what_cannot_be_played_is_said_and_a_path_is_made(tmp_path, caplog):
    scene = record_of(all_around())
    record(tmp_path / "viewer", "camera_path_001.yaml", 10, 5.0)
    (tmp_path / "viewer" / "camera_path_001.yaml").write_text("keyframes: 3")
    assert len(page_path(AutoPath(), scene, tmp_path)) == 25
    assert "does not play what was recorded last" in caplog.text
    refused(page_path, PhotographPath(views=["absent"]), scene, tmp_path, parts=("absent",))


def test_nothing_is_taken_through_a_link(tmp_path):
    record(tmp_path / "elsewhere", "camera_path_001.yaml", 10, 5.0)
    run = tmp_path / "run"
    run.mkdir()
    (run / "viewer").symlink_to(tmp_path / "elsewhere")
    assert len(page_path(AutoPath(), record_of(all_around()), run)) == 25
