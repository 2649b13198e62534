"""The panel: what is saved where it can be, and what is not there is said."""

import math
from dataclasses import replace
from unittest.mock import MagicMock

import pytest
from support.scenes import ball_scene, tiny_model

from nerf_lightning.checkpoints.reading import scene_record
from nerf_lightning.video.paths.base import frame_of
from nerf_lightning.viewer import controls, limits
from nerf_lightning.viewer.client import ViewerClient
from nerf_lightning.viewer.controls import Controls
from nerf_lightning.viewer.frusta import quaternion_of
from nerf_lightning.viewer.render_queue import RenderQueue
from nerf_lightning.viewer.renderer import SlicedRenderer
from nerf_lightning.viewer.shown_photographs import Photographs

HEIGHT = 12


class Handle:
    """Something on the panel; `act` is what the page calls."""

    def __init__(self, value):
        self.value = value

    def on_update(self, function):
        self.act = function

    on_click = on_update

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass


class Gui:
    """What has been put on the panel, by its label or its text."""

    def __init__(self):
        self.made = {}

    def __getattr__(self, kind):
        def add(label, *values, initial_value=None, **options):
            self.made[label] = Handle(values[-1] if values and initial_value is None else initial_value)
            return self.made[label]

        return add


class Panel:
    """A person's panel over a ball, and the queue that serves them."""

    def __init__(self, folder, **changed):
        scene = ball_scene(num_views=4, size=16)
        record = replace(scene_record(scene), **changed)
        self.queue = RenderQueue(SlicedRenderer(tiny_model().eval(), record, "white", 4096))
        self.client, self.gui = MagicMock(client_id=1), Gui()
        self.client.gui = self.gui
        c2w, camera = record.cameras.c2w[0], self.client.camera
        camera.wxyz, camera.position, camera.fov = quaternion_of(c2w), c2w[:, 3].double().numpy(), 0.6
        camera.image_width, camera.image_height = 16, HEIGHT
        around = frame_of(record.cameras, record.aabb)
        self.session = ViewerClient(self.client, self.queue, Photographs(record, None, "white"), around, HEIGHT)
        self.session.start()
        Controls(self.session, folder)

    def work(self):
        while self.queue.work():
            pass

    def snapshot(self):
        """Click, wait for the picture, and return what the page says."""
        self.gui.made["Snapshot"].act(None)
        self.work()
        (title, text), _ = self.client.add_notification.call_args
        assert title == "Snapshot"
        return text


def test_a_snapshot_makes_its_folder_and_says_where_it_is(tmp_path):
    panel = Panel(tmp_path / "viewer")
    panel.work()
    assert not list(tmp_path.iterdir())
    assert panel.snapshot() == f"Saved as {tmp_path}/viewer/snapshot_001.png"
    assert panel.snapshot() == f"Saved as {tmp_path}/viewer/snapshot_002.png"
    assert len(list((tmp_path / "viewer").iterdir())) == 2


def test_a_full_disk_is_said_and_ends_nothing(tmp_path, monkeypatch):
    def full(path, picture):
        raise OSError(28, "No space left on device", str(path))

    panel = Panel(tmp_path)
    monkeypatch.setattr(controls, "save_png", full)
    assert "It could not be saved: [Errno 28] No space left on device" in panel.snapshot()
    monkeypatch.undo()
    assert panel.snapshot() == f"Saved as {tmp_path}/snapshot_001.png"


def test_a_place_that_cannot_be_a_folder_is_said(tmp_path):
    (tmp_path / "viewer").write_text("")
    assert "could not be saved" in Panel(tmp_path / "viewer" / "deeper").snapshot()


def test_snapshots_are_limited_and_it_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "MOST_SNAPSHOTS", 2)
    panel = Panel(tmp_path)
    assert [panel.snapshot() for _ in range(3)][-1].startswith(
        f"It could not be saved: {tmp_path} holds 2 of them, the most that the page writes. Make room"
    )
    assert len(list(tmp_path.iterdir())) == 2


def test_values_that_no_slider_has_are_clamped(tmp_path):
    panel = Panel(tmp_path)
    made = panel.gui.made
    made["Field of view"].value = 1e9
    made["Field of view"].act(None)
    assert panel.client.camera.fov == pytest.approx(math.radians(120))
    made["Show"].value = "no channel"
    made["Show"].act(None)
    assert panel.session.channel == "colour"
    made["x"].value = (5.0, -5.0)
    made["Show only what is in the box"].value = True
    made["x"].act(None)
    assert panel.session.crop.size[0].item() == pytest.approx(0.02)
    made["Photograph | render"].value = -3.0
    made["Photograph | render"].act(None)
    assert panel.session.split == 0
    made["View"].value = -(10**9)
    made["Look through it"].act(None)
    assert panel.session.photograph == 0


def test_a_click_that_fails_is_a_line_in_the_log(tmp_path, monkeypatch, caplog):
    panel = Panel(tmp_path)
    monkeypatch.setattr(panel.session, "enter", lambda view: 1 / 0)
    for _ in range(3):
        panel.gui.made["Look through it"].act(None)
    assert caplog.text.count("ZeroDivisionError") == 1
    assert "Traceback" not in caplog.text


def test_a_name_is_shown_as_text(tmp_path):
    names = ("<iframe srcdoc='<script>1</script>'></iframe>", "b", "c", "d")
    panel = Panel(tmp_path, view_names=names)
    panel.gui.made["Look through it"].act(None)
    assert f"`{names[0]}`" in panel.gui.made[""].content


def test_the_crop_box_is_the_scenes(tmp_path):
    panel = Panel(tmp_path)
    assert panel.gui.made["x"].value == pytest.approx((-1.0, 1.0))
    panel.gui.made["Show only what is in the box"].value = True
    panel.gui.made["z"].value = (0.0, 0.5)
    panel.gui.made["z"].act(None)
    assert panel.session.crop.size.tolist() == pytest.approx([2.0, 2.0, 0.5])
    assert panel.queue.work()


def test_without_a_crop_box_it_is_said_why(tmp_path):
    panel = Panel(tmp_path, space="ndc")
    assert "Show only what is in the box" not in panel.gui.made
    assert "Crop box" in panel.gui.made
    assert any("forward-facing capture" in label for label in panel.gui.made)
