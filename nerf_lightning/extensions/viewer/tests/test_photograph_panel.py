"""Photographs are chosen by their names, looked through, and left."""

from unittest.mock import MagicMock

from support.scenes import ball_scene
from support.viewer_panel import Panel

CHOICE, SPLIT = "Photograph", "Photograph | Render"


def test_a_photograph_is_chosen_by_its_name_looked_through_and_left(tmp_path):
    panel = Panel(tmp_path, ball_scene(num_views=4, size=16))
    panel.set(CHOICE, "ball_3")
    assert panel.session.photograph == 3
    assert "` ball_3 `" in panel.controls.photographs.name.content
    panel.set(SPLIT, 0.25)
    assert panel.session.split == 0.25
    panel.press("Leave photograph")
    assert panel.session.photograph is None
    assert panel.gui.made[CHOICE].value == "none"


def test_a_clicked_camera_is_the_one_in_the_list(tmp_path):
    panel = Panel(tmp_path, ball_scene(num_views=4, size=16))
    panel.controls.frusta.on_click(2)
    assert panel.gui.made[CHOICE].value == "ball_2"
    panel.set(CHOICE, "none")
    assert panel.session.photograph is None


def test_without_photographs_at_hand_it_is_said(tmp_path):
    panel = Panel(tmp_path)
    panel.set(CHOICE, "ball_2")
    assert "its photograph is not available" in panel.controls.photographs.name.content
    assert not panel.gui.made[SPLIT].visible


def test_photographs_that_come_later_are_on_the_cameras(tmp_path):
    panel = Panel(tmp_path)
    panel.set("Show cameras", True)
    panel.session.photographs.take(ball_scene(num_views=4, size=16))
    images = [call.kwargs["image"] for call in panel.client.scene.add_camera_frustum.call_args_list]
    assert [image is None for image in images] == [True] * 4 + [False] * 4


def test_a_name_is_shown_as_text(tmp_path):
    names = ("<iframe srcdoc='<script>1</script>'></iframe>", "b\x1b[0m", "c", "d")
    panel = Panel(tmp_path, view_names=names)
    labels = panel.gui.made[CHOICE].options
    assert labels[2] == "b\\x1b[0m"
    panel.set(CHOICE, labels[1])
    assert f"` {names[0]} `" in panel.controls.photographs.name.content


def test_names_that_are_shortened_alike_get_a_number(tmp_path):
    panel = Panel(tmp_path, view_names=("none", "b" * 80, "b" * 81, "c"))
    first, long, longer, other = panel.gui.made[CHOICE].options[1:]
    assert (first, other) == ("0: none", "c")
    assert long.startswith("1: bbb")
    panel.set(CHOICE, longer)
    assert panel.session.photograph == 2


def test_cameras_around_the_viewer_are_hidden(tmp_path):
    panel = Panel(tmp_path)
    cameras = [MagicMock(visible=True) for _ in range(4)]
    panel.client.scene.add_camera_frustum.side_effect = cameras
    panel.set("Show cameras", True)
    assert [camera.visible for camera in cameras] == [False, True, True, True]
