"""A film from the page: it is rendered beside what people look at, says how far it is, and can be stopped."""

import numpy as np
import pytest
from support.videos import read_video
from support.viewer_panel import Panel

from nerf_lightning.viewer.film import FILM, end_film


@pytest.fixture
def panel(tmp_path):
    panel = Panel(tmp_path / "viewer")
    for x in (4.0, 4.2):
        panel.client.camera.position = np.array([x, 0.0, 2.0])
        panel.press("Add keyframe")
    panel.set("Seconds to it", 0.2)
    panel.gui.made["Width"].value = 32
    return panel


def said(panel):
    return panel.gui.made["The camera path becomes a video."].content


def finished(panel):
    panel.work()
    panel.wait(lambda: panel.queue.turn_of(FILM) is None)


def test_the_path_becomes_a_film_that_is_downloaded(panel, tmp_path):
    panel.work()
    panel.press("Render film")
    while "Frame 3 of" not in said(panel):
        panel.queue.work()
    assert said(panel) == "Frame 3 of 7"
    assert panel.controls.film.bar.value == pytest.approx(300 / 7)
    # Who moves a camera comes first.
    panel.session.look()
    panel.queue.work()
    assert said(panel) == "Frame 3 of 7"
    finished(panel)
    film = tmp_path / "viewer" / "film_001" / "video.mp4"
    panel.wait(lambda: said(panel) == f"The film is at `{film}`")
    assert sorted(each.name for each in film.parent.iterdir()) == ["camera_path.yaml", "video.mp4"]
    assert read_video(film)[1].shape == (7, 32, 32, 3)
    panel.press("Download")
    (name, content), _ = panel.client.send_file_download.call_args
    assert (name, content) == ("film_001.mp4", film.read_bytes())


@pytest.mark.parametrize("stop", [lambda panel: panel.press("Stop the film"), lambda panel: end_film(panel.queue)])
def test_a_film_is_stopped_and_leaves_nothing(panel, tmp_path, stop):
    panel.press("Render film")
    for _ in range(4):
        panel.queue.work()
    stop(panel)
    finished(panel)
    assert "The film was stopped." in said(panel)
    assert list((tmp_path / "viewer").iterdir()) == []
    assert panel.gui.made["Render film"].visible


def test_a_film_goes_on_when_its_maker_goes_and_stays_when_the_next_one_fails(panel, tmp_path):
    panel.press("Render film")
    panel.press("Render film")
    assert said(panel).startswith("Another film is being made.")
    panel.queue.remove(panel.client.client_id)
    finished(panel)
    (tmp_path / "viewer").rename(tmp_path / "kept")
    (tmp_path / "viewer").write_text("")
    panel.press("Render film")
    assert panel.queue.turn_of(FILM) is None
    assert (tmp_path / "kept" / "film_001" / "video.mp4").is_file()


def test_what_cannot_be_filmed_is_said_and_leaves_nothing(panel, tmp_path):
    panel.session.crop_corners = ((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0))
    panel.press("Render film")
    finished(panel)
    assert "stands inside the box" in said(panel)
    assert list((tmp_path / "viewer").iterdir()) == []
    panel.press("Delete keyframe")
    panel.press("Render film")
    assert said(panel).startswith("Add two keyframes")


def test_a_frame_that_cannot_be_rendered_ends_the_film_alone(panel, tmp_path, monkeypatch):
    panel.press("Render film")
    panel.queue.work()
    monkeypatch.setattr(type(panel.queue.renderer.model), "forward", lambda *_: 1 / 0)
    finished(panel)
    assert "could not be rendered" in said(panel)
    assert list((tmp_path / "viewer").iterdir()) == []


def test_numbers_that_no_control_has_are_clamped(panel, tmp_path):
    panel.gui.made["Width"].value, panel.gui.made["Frame rate"].value = -(10**9), -5
    panel.press("Render film")
    finished(panel)
    assert read_video(tmp_path / "viewer" / "film_001" / "video.mp4")[1].shape == (1, 32, 32, 3)
