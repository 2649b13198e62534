"""The panel's camera path: what users change, and what is drawn of it."""

import numpy as np
import pytest
from support.viewer_panel import Panel

from nerf_lightning.extensions.viewer import path_panel


@pytest.fixture
def panel(tmp_path):
    panel = Panel(tmp_path / "viewer")
    for x in (4.0, 5.0, 6.0):
        panel.client.camera.position = np.array([x, 0.0, 2.0])
        panel.press("Add keyframe")
    return panel


def places(panel):
    return [each.position[0] for each in panel.controls.path.keyframes]


def test_keyframes_are_timed_and_deleted(panel):
    panel.set("Keyframe", "2")
    panel.set("Transition (s)", 0.5)
    assert panel.controls.path.times == [0.0, 0.5, 2.5]
    assert panel.said() == "3 keyframes, 2.5 s"
    panel.set("Transition (s)", -1e9)
    assert panel.controls.path.times == [0.0, 0.1, 2.1]
    panel.press("Delete keyframe")
    assert places(panel) == [4.0, 6.0]
    for _ in range(2):
        panel.press("Delete keyframe")
    assert panel.said() == "No keyframes yet."
    assert not panel.gui.made["Time"].visible


def test_a_keyframe_comes_after_the_chosen_one_and_the_time_line_is_as_long_as_the_path(panel):
    assert panel.gui.made["Time"].max == 4.0
    panel.set("Time", 2.0)
    assert panel.client.camera.position.tolist() == pytest.approx([5.0, 0.0, 2.0])
    panel.set("Keyframe", "1")
    panel.client.camera.position = np.array([4.5, 0.0, 2.0])
    panel.press("Add keyframe")
    assert places(panel) == [4.0, 4.5, 5.0, 6.0]
    assert panel.gui.made["Keyframe"].value == "2"


def test_playing_goes_along_the_path_hides_what_is_drawn_and_ends(panel, monkeypatch):
    monkeypatch.setattr(path_panel, "PER_SECOND", 50)
    panel.set("Transition (s)", 0.1)
    panel.set("Time", 1.9)
    overlay = panel.controls.frusta.root
    panel.press("Play")
    assert overlay.visible is False
    assert panel.gui.made["Play"].label == "Pause"
    panel.wait(lambda: panel.gui.made["Play"].label == "Play")
    assert panel.gui.made["Time"].value == pytest.approx(2.1)
    assert panel.client.camera.position.tolist() == pytest.approx([6.0, 0.0, 2.0])
    panel.wait(lambda: overlay.visible)
    for label in ("Pause", "Play"):
        panel.press("Play")
        assert panel.gui.made["Play"].label == label


def test_playing_ends_when_the_browser_goes(panel):
    panel.press("Play")
    panel.queue.remove(panel.client.client_id)
    panel.wait(lambda: panel.gui.made["Play"].label == "Play")


def test_whoever_adds_a_keyframe_does_not_stand_in_its_lines(tmp_path):
    """Its camera is drawn at the user's viewpoint: from within, it is bars across the picture."""
    panel = Panel(tmp_path)
    panel.press("Add keyframe")
    camera = panel.client.scene.add_camera_frustum.return_value
    assert camera.visible is False
    panel.client.camera.position = panel.client.camera.position + np.array([0.0, 0.0, 1.0])
    panel.session.request_view()
    assert camera.visible is True


def test_content_hides_what_is_drawn_behind_it(tmp_path):
    panel = Panel(tmp_path)
    panel.work()
    assert panel.depth_sent() is None  # nothing is drawn
    panel.set("Show only what is in the box", True)
    panel.work()
    assert panel.depth_sent().shape == (12, 16)
    panel.set("Show only what is in the box", False)
    assert panel.depth_sent() is None


def test_a_saved_path_is_listed_and_loaded(panel, tmp_path):
    assert panel.gui.made["Load path"].disabled  # nothing was saved
    panel.press("Save path")
    assert "` path=keyframes path.file=" in panel.said()
    assert panel.gui.made["Saved paths"].options == ("camera_path_001.yaml",)
    assert not panel.gui.made["Load path"].disabled
    (tmp_path / "viewer" / "bad.yaml").write_text("- {position: [0, 0, 1]}\n")
    panel.press("Delete keyframe")
    panel.press("Load path")
    assert places(panel) == [4.0, 5.0, 6.0]
    panel.set("Saved paths", "bad.yaml")
    panel.press("Load path")
    assert "must have a position" in panel.said()
    assert places(panel) == [4.0, 5.0, 6.0]


def test_a_place_that_cannot_be_written_is_said(panel, tmp_path):
    (tmp_path / "viewer").write_text("")
    panel.press("Save path")
    assert "It could not be saved: [Errno 17] File exists" in panel.said()


def test_a_folders_name_is_no_markup(tmp_path):
    panel = Panel(tmp_path / "<script>")
    for _ in range(2):
        panel.press("Add keyframe")
    panel.press("Save path")
    assert panel.said().endswith(f"` path=keyframes path.file={tmp_path}/<script>/camera_path_001.yaml `")
