"""The gate for browsers' messages: whatever comes in, what passes is in range, and only what the page sends passes."""

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("viser", reason="viser is not installed: pip install 'nerf-lightning[viewer]'")

from nerf_lightning.viewer import limits
from nerf_lightning.viewer.messages import admitted

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [1, 2.0, 3.0],
    "fov": 0.6,
    "near": 0.01,
    "far": 100.0,
    "image_height": 240,
    "image_width": 320,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


def passed(message):
    """Return what passes of a message, or None."""
    through = admitted(msgspec.msgpack.encode(message))
    return None if through is None else msgspec.msgpack.decode(through)


def test_what_the_page_sends_passes_unchanged():
    assert passed(CAMERA) == CAMERA
    slider = {"type": "GuiUpdateMessage", "uuid": "a-b", "updates": {"value": [0.25, 0.5]}}
    assert passed(slider) == slider
    button = {"type": "GuiUpdateMessage", "uuid": "a-b", "updates": {"value": True}}
    assert passed(button) == button
    click = {
        "type": "SceneNodeClickMessage",
        "name": "/overlay/cameras/3",
        "instance_index": None,
        "ray_origin": [0.0, 0.0, 1.0],
        "ray_direction": [0.0, 1.0, 0.0],
        "screen_pos": [0.5, 0.25],
        "modifier": None,
        "owner": "1",
    }
    assert passed(click) == click


@pytest.mark.parametrize(
    "kind",
    ["ShareUrlRequest", "FileTransferStartUpload", "FileTransferPart", "GetRenderResponseMessage", "x", "", 3, None],
)
def test_messages_of_other_kinds_are_dropped(kind):
    assert passed(CAMERA | {"type": kind}) is None


@given(st.sampled_from(sorted(CAMERA.keys() - {"type"})), VALUES)
def test_a_camera_is_in_range_or_dropped(key, value):
    through = passed(CAMERA | {key: value})
    if through is None:
        return
    assert through.keys() == CAMERA.keys()
    width, height = through["image_width"], through["image_height"]
    assert 1 <= width <= limits.MOST_SIDE
    assert 1 <= height <= limits.MOST_SIDE
    assert width * height <= limits.MOST_PIXELS
    assert limits.LEAST_FOV <= through["fov"] <= limits.MOST_FOV
    assert all(abs(each) <= limits.MOST_COORDINATE for name in ("position", "look_at") for each in through[name])
    assert math.hypot(*through["wxyz"]) == pytest.approx(1)
    assert math.hypot(*through["up_direction"]) == pytest.approx(1)


@given(VALUES, VALUES)
def test_a_value_of_the_panel_is_plain_or_dropped(uuid, value):
    through = passed({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value, "removed": value}})
    if through is not None:
        assert through["updates"].keys() == {"value"}


@given(st.binary())
def test_bytes_are_no_message_or_one_of_the_pages(raw):
    through = admitted(raw)
    assert through is None or msgspec.msgpack.decode(through)["type"] in ("ViewerCameraMessage", "GuiUpdateMessage")


@given(st.dictionaries(st.sampled_from([*CAMERA, "extra"]), VALUES))
def test_no_camera_of_other_parts_gets_in_the_way(parts):
    assert (
        passed({"type": "ViewerCameraMessage"} | parts) is None or "extra" not in parts or parts.keys() >= CAMERA.keys()
    )


def test_text_is_no_message():
    assert admitted("text") is None
