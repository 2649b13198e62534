"""Photographs are chosen by their pictures."""

import base64
import io
import re

import numpy as np
import pytest
from PIL import Image
from support.scenes import ball_scene
from support.viewer_panel import Panel


def buttons(panel):
    """The pictures that may be clicked now, by their names."""
    return {each.label: each for each in panel.controls.photographs._pictures}


@pytest.fixture
def panel(tmp_path):
    return Panel(tmp_path, ball_scene(num_views=20, size=16))


def test_a_photograph_is_chosen_by_its_picture_and_looked_through(panel):
    scene = ball_scene(num_views=20, size=16)
    chosen = buttons(panel)["ball_3"]
    sent = base64.b64decode(re.search(r"base64,([^\"]+)", chosen._icon_html)[1])
    shown = np.array(Image.open(io.BytesIO(sent)).resize((16, 16), Image.Resampling.BOX)).astype(float)
    rgba = scene.pixels.view(3).numpy().astype(float)
    truth = rgba[..., :3] * rgba[..., 3:] / 255 + 255 - rgba[..., 3:]
    assert np.abs(shown - truth).mean() < 12
    chosen.act(None)
    assert panel.session.photograph == 3
    assert "`ball_3`" in panel.controls.photographs.name.content
    panel.set("Photograph | render", 0.25)
    assert panel.session.split == 0.25
    panel.press("Leave")
    assert panel.session.photograph is None


def test_many_photographs_are_turned_like_pages_and_found_by_name(panel):
    turn = panel.gui.made["Pictures"]
    assert list(buttons(panel)) == [f"ball_{view}" for view in range(9)]
    labels = ("1-9 of 20", "10-18 of 20", "19-20 of 20", "19-20 of 20")
    for way, label in zip(("Previous", "Next", "Next", "Next"), labels, strict=True):
        panel.set("Pictures", way)
        assert turn.label == label
    assert list(buttons(panel)) == ["ball_18", "ball_19"]
    panel.set("Find", "L_1")
    assert list(buttons(panel)) == ["ball_1", *(f"ball_{view}" for view in range(10, 18))]
    buttons(panel)["ball_12"].act(None)
    assert panel.session.photograph == 12
    panel.set("Find", "<nothing>")
    assert turn.label == "None found"


def test_without_photographs_at_hand_there_are_names_and_it_is_said(tmp_path):
    panel = Panel(tmp_path)
    assert "image/gif" in buttons(panel)["ball_2"]._icon_html
    buttons(panel)["ball_2"].act(None)
    assert "its photograph is not at hand" in panel.controls.photographs.name.content
    assert not panel.gui.made["Photograph | render"].visible


def test_photographs_that_come_later_take_their_places(tmp_path):
    panel = Panel(tmp_path)
    panel.controls.photographs.frusta.cameras.visible = False
    panel.session.photographs.take(ball_scene(num_views=4, size=16))
    assert "image/jpeg" in buttons(panel)["ball_2"]._icon_html


def test_a_name_is_shown_as_text(tmp_path):
    names = ("<iframe srcdoc='<script>1</script>'></iframe>", 'b"><img src=x onerror=1>', "c", "d")
    panel = Panel(tmp_path, view_names=names)
    first, second, *_ = panel.controls.photographs._pictures
    first.act(None)
    assert f"`{names[0]}`" in panel.controls.photographs.name.content
    assert "onerror" not in second._icon_html
