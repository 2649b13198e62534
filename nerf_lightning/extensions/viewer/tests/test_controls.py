"""The panel: files are saved where possible, and missing ones are reported."""

import re
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.viewer_panel import Panel

from nerf_lightning.extensions.viewer import controls
from nerf_lightning.messages.escaping import as_code, for_terminal
from nerf_lightning.runs.file_steps import STEPS, exported_files


def snapshot(panel):
    """Click, wait for the picture, and return what the page says."""
    panel.press("Save picture")
    panel.work()
    (title, text), _ = panel.client.add_notification.call_args
    assert title == "Save picture"
    return text


def seen(panel, height, width):
    """A view of this size, everything in which is three units away."""
    last, _ = panel.session._last_view
    return replace(
        last,
        rgb=torch.ones(height, width, 3),
        depth=torch.full((height, width), 3.0),
        opacity=torch.ones(height, width),
    )


def test_a_snapshot_makes_its_folder_and_says_where_it_is(tmp_path):
    panel = Panel(tmp_path / "viewer")
    panel.work()
    assert not list(tmp_path.iterdir())
    assert snapshot(panel) == f"Saved as {tmp_path}/viewer/snapshot_001.png"
    assert snapshot(panel) == f"Saved as {tmp_path}/viewer/snapshot_002.png"
    assert len(list((tmp_path / "viewer").iterdir())) == 2


def test_the_size_of_the_picture_is_on_the_panel():
    panel = Panel(Path())
    panel.work()
    panel.session.on_picture(seen(panel, 6, 8), False)
    assert panel.controls.status.content == "Rendered at 8 x 6, refining"
    panel.session.refinement.refresh()
    panel.work()
    assert panel.controls.status.content == "Rendered at 16 x 12"


def test_the_scale_of_depths_is_shown_with_them_in_the_captures_units():
    panel = Panel(
        Path(), to_user=torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0], dtype=torch.float64)), metres_per_unit=0.5
    )
    assert not panel.controls.scale.visible
    panel.set("Shown", "Depth")
    assert panel.controls.scale.visible
    panel.work()
    panel.session.on_picture(seen(panel, 2, 2), True)
    assert "near 3 m" in panel.controls.scale.content


def test_on_phones_the_panel_begins_folded(tmp_path):
    assert "Controls" in Panel(tmp_path, width=6).gui.made
    assert "Controls" not in Panel(tmp_path).gui.made


def test_a_full_disk_is_said_and_ends_nothing(tmp_path, monkeypatch):
    def full(path, picture):
        raise OSError(28, "No space left on device", str(path))

    panel = Panel(tmp_path)
    monkeypatch.setattr(controls, "save_png", full)
    assert "It could not be saved: [Errno 28] No space left on device" in snapshot(panel)
    monkeypatch.undo()
    assert snapshot(panel) == f"Saved as {tmp_path}/snapshot_001.png"


def test_a_place_that_cannot_be_a_folder_is_said(tmp_path):
    (tmp_path / "viewer").write_text("")
    assert "could not be saved" in snapshot(Panel(tmp_path / "viewer" / "deeper"))


def test_a_click_that_fails_is_a_line_in_the_log(tmp_path, monkeypatch, caplog):
    panel = Panel(tmp_path)
    monkeypatch.setattr(panel.session, "enter", lambda view: 1 / 0)
    for _ in range(3):
        panel.set("Photograph", "ball_0")
    assert caplog.text.count("ZeroDivisionError") == 1
    assert "Traceback" not in caplog.text


def test_the_last_movement_wins_over_one_that_is_still_being_read(tmp_path):
    panel = Panel(tmp_path)
    session, plain, read, go = panel.session, panel.session.pose, threading.Event(), threading.Event()

    def slow():
        session.pose = plain
        old = plain()
        read.set()
        assert go.wait(20)
        return old

    session.pose, session.on_move = slow, lambda: None
    threads = [threading.Thread(target=session.request_view) for _ in range(2)]
    threads[0].start()
    assert read.wait(20)
    panel.client.camera.position = np.array([1.0, 2.0, 3.0])
    threads[1].start()
    threads[1].join(0.2)
    go.set()
    for each in threads:
        each.join()
    assert session.refinement.wish.c2w[:, 3].tolist() == [1.0, 2.0, 3.0]


def test_the_crop_box_is_the_scenes(tmp_path):
    panel = Panel(tmp_path)
    assert panel.gui.made["x: -1 to 1"].value == pytest.approx((-1.0, 1.0))
    drawn = panel.client.scene.add_line_segments
    panel.set("x: -1 to 1", (-0.5, 1.0))
    assert panel.session.crop is None  # only its outline is shown
    ends = drawn.call_args.args[1]
    assert ends.shape == (12, 2, 3)
    assert ends.reshape(-1, 3).min(axis=0).tolist() == pytest.approx([-0.5, -1.0, -1.0])
    assert ends.reshape(-1, 3).max(axis=0).tolist() == pytest.approx([1.0, 1.0, 1.0])
    panel.set("x: -1 to 1", (-1.0, 1.0))
    assert drawn.call_count == 1
    panel.gui.made["Show only what is in the box"].value = True
    panel.gui.made["z: -1 to 1"].value = (0.0, 0.5)
    panel.gui.made["z: -1 to 1"].act(None)
    assert panel.gui.made["z: -1 to 1"].label == "z: 0 to 0.5"
    assert panel.session.crop.size.tolist() == pytest.approx([2.0, 2.0, 0.5])
    assert panel.queue.work()


def test_without_a_crop_box_it_is_said_why(tmp_path):
    panel = Panel(tmp_path, space="ndc")
    assert "Show only what is in the box" not in panel.gui.made
    assert "Crop box" in panel.gui.made
    assert any("forward-facing capture" in label for label in map(str, panel.gui.made))


@given(st.text())
def test_nothing_ends_the_code_span_early(text):
    """CommonMark 6.1: a code span ends at the first run of backticks as long as the one that began it."""
    shown = as_code(text)
    fence = re.match("`+", shown)[0]
    inner = shown[len(fence) : -len(fence)]
    assert inner == f" {for_terminal(text)} "
    assert all(len(run) != len(fence) for run in re.findall("`+", inner))


def test_surrogates_and_line_ends_are_shown_as_something_and_long_texts_are_cut():
    assert as_code("a\udc80\n\nb\u202e") == r"` a\udc80\n\nb\u202e `"
    assert for_terminal("a" * 10**6, 3) == "aaa…"


def test_exported_files_are_downloaded_and_one_that_has_gone_is_said(tmp_path):
    assert exported_files(tmp_path / "none") == []
    for name in ("splats.ply", ".part", STEPS):
        (tmp_path / name).write_bytes(b"ply")
    (tmp_path / "link.ply").symlink_to(tmp_path / "splats.ply")
    panel = Panel(tmp_path, exports=tmp_path)
    (button,) = (label for label in panel.gui.made if label.startswith("splats.ply ("))
    assert not any(label.startswith(("link.ply", ".part", STEPS)) for label in panel.gui.made)
    panel.press(button)
    panel.client.send_file_download.assert_called_once_with("splats.ply", b"ply")
    (tmp_path / "splats.ply").unlink()
    panel.press(button)
    panel.client.send_file_download.assert_called_once()
