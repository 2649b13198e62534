"""Whatever somebody with a token sends: it harms neither the page, nor the others, nor the terminal."""

import contextlib
import math
import os
import socket
import time
from http.client import HTTPException

import msgspec
import pytest
from support.served_page import HEIGHT, served
from websockets.exceptions import InvalidStatus

from nerf_lightning.viewer import limits


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with served(tmp_path_factory.mktemp("page")) as page:
        yield page


@pytest.fixture
def client(page):
    client = page.client()
    yield client
    client.close()


@pytest.fixture(autouse=True)
def _terminal_stays_clean(capfd, caplog):
    yield
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err + caplog.text
    assert "rror" not in out + err


NOT_NUMBERS = [math.nan, math.inf, -math.inf, "x", None, [], {}, True]


@pytest.mark.parametrize("key", ["fov", "image_width", "image_height"])
def test_a_camera_with_an_impossible_number_harms_nothing(page, client, key):
    for value in [0, -1, 1e-300, 1e9, 4e8, 2**63, *NOT_NUMBERS]:
        client.look_from(0, **{key: value})
    client.look_from(30)
    client.wait_for_height(HEIGHT)
    assert all(max(each.shape) <= limits.MOST_SIDE for each in client.pictures)


@pytest.mark.parametrize("key", ["position", "wxyz", "look_at", "up_direction"])
def test_a_camera_in_an_impossible_place_harms_nothing(page, client, key):
    client.look_from(0)
    for bad in [[0.0] * 4, [0.0] * 3, [math.nan] * 3, [1e300] * 3, [9e30] * 4, [1.0], [], "abc", None]:
        client.look_from(0, **{key: bad})
        client.set("Add keyframe", True)
    client.look_from(30)
    client.wait_for_height(HEIGHT)


@pytest.mark.parametrize(("width", "height"), [(10**9, 10), (10, 10**9), (10**9, 10**9), (1, 1), (4096, 720)])
def test_a_window_of_an_impossible_shape_asks_for_a_bounded_picture(page, client, width, height):
    client.look_from(0, image_width=width, image_height=height)
    client.wait_for(len)
    picture = client.pictures[-1]
    assert picture.shape[0] <= HEIGHT
    assert picture.shape[1] <= limits.MOST_SIDE
    assert picture.shape[0] * picture.shape[1] <= limits.MOST_SQUARES * HEIGHT**2 * 1.05 + limits.MOST_SIDE
    page.still_serves()


def test_after_impossible_cameras_others_are_served(page):
    for changed in ({"fov": 0.0}, {"fov": math.inf}, {"image_width": 4e8}, {"image_width": 10**9, "image_height": 10}):
        hostile = page.client()
        hostile.look_from(0, **changed)
        hostile.close()
    page.still_serves()


GARBAGE = [
    b"",
    b"\xff" * 40,
    os.urandom(300),
    msgspec.msgpack.encode([1, 2]),
    msgspec.msgpack.encode({}),
    msgspec.msgpack.encode({"type": ["x"]}),
    msgspec.msgpack.encode({"type": "NoSuchMessage"}),
    msgspec.msgpack.encode({"type": "ViewerCameraMessage"}),
    msgspec.msgpack.encode({"type": "ViewerCameraMessage", "extra": 1}),
    msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": 3, "updates": 4}),
    msgspec.msgpack.encode({"type": "FileTransferPart", "content": b"x"}),
    b"\x81" * 60_000,  # lists in lists
    "a text",
]


def test_garbage_in_a_frame_is_dropped(page, client):
    client.look_from(0)
    client.wait_for(len)
    for message in GARBAGE:
        client.socket.send(message)
    client.look_from(90)
    before = len(client.pictures)
    client.wait_for_height(HEIGHT, after=before)


def test_a_message_larger_than_any_of_the_page_closes_its_client_alone(page, client):
    client.look_from(0)
    client.wait_for(len)
    client.socket.send(bytes(limits.MOST_MESSAGE_BYTES + 1))
    wait(lambda: client.socket.protocol.state.name == "CLOSED")
    page.still_serves()


@pytest.mark.parametrize(
    "raw", [b"\xff" * 100, b"\x00" * 20_000, b"GET / HTTP/1.1\r\nHost", b"POST / HTTP/1.1\r\n\r\n", b""]
)
def test_garbage_on_the_port_harms_nothing(page, raw):
    with socket.create_connection(("127.0.0.1", page.port)) as line:
        line.sendall(raw)
        page.still_serves()


def test_malformed_frames_close_their_client_alone(page, client):
    client.look_from(0)
    client.wait_for(len)
    client.socket.socket.sendall(b"\xff\xff" + os.urandom(200))
    page.still_serves()


UPDATES = [
    {"value": None},
    {"value": math.nan},
    {"value": "x" * 9999},
    {"value": [1]},
    {"value": {}},
    {"update_cb": 1},
    {"removed": True},
    {"sync_cb": "x"},
]


@pytest.mark.parametrize(
    "label",
    ["Show", "Field of view", "1-4 of 4", "Find", "x", "Seconds to it", "Change it", "Time", "Saved", "Add keyframe"],
)
def test_impossible_values_on_the_panel_are_dropped(page, client, label):
    client.look_from(0)
    for updates in UPDATES:
        client.update(label, updates)
    client.set("ball_0", True)
    client.look_from(90)
    client.wait_for_height(HEIGHT)


def test_out_of_range_on_the_panel_is_clamped(page, client):
    client.look_from(0)
    for label, value in {"Field of view": 1e9, "Show": "no channel", "Saved": "../x"}.items():
        client.set(label, value)
    client.set("Add keyframe", True)
    client.set("Add keyframe", True)
    for label, value in {"Seconds to it": -1e9, "Keyframe": "-7", "Change it": "x", "Move it": "", "Time": 1e9}.items():
        client.set(label, value)
    client.set("Load", True)
    client.set("Play", True)
    client.set("ball_0", True)
    client.set("x", [9e8, -9e8])
    client.set("Show only what is in the box", True)
    client.look_from(90)
    client.wait_for_height(HEIGHT)
    page.still_serves()


def test_nobody_publishes_the_page_through_somebody_elses_server(page, client, monkeypatch):
    """The share button, which the page does not show, is a message that anybody can send."""
    asked = []
    monkeypatch.setattr(page.page.server, "request_share_url", lambda *_: asked.append(1))
    monkeypatch.setattr(type(page.page.server), "request_share_url", lambda *_: asked.append(1))
    client.look_from(0)
    client.send({"type": "ShareUrlRequest"})
    client.wait_for(len)
    time.sleep(0.1)
    assert not asked


def test_a_flood_of_messages_is_thinned(page, client, monkeypatch):
    wishes = []
    monkeypatch.setattr("nerf_lightning.viewer.client.ViewerClient.look", lambda self: wishes.append(1))
    began = time.monotonic()
    for number in range(6 * limits.MOST_MESSAGES_PER_SECOND):
        client.look_from(number)
    client.socket.ping().wait(20)
    seconds = time.monotonic() - began
    assert 0 < len(wishes) <= (seconds + 1.5) * limits.MOST_MESSAGES_PER_SECOND


def test_a_flood_of_pings_closes_its_client_alone(page, client):
    """Each wants an answer, which waits in memory where nobody reads it."""
    client.look_from(0)
    client.wait_for(len)
    pings = 200_000 * (b"\x89\xfd\x00\x00\x00\x00" + bytes(125))
    # Reset by the page, or closed by the client's own thread, which has noticed that first.
    with pytest.raises(OSError, match=r"reset|pipe|file descriptor"):
        client.socket.socket.sendall(pings)
    page.still_serves()


def test_an_error_while_drawing_for_one_ends_neither_the_page_nor_the_loop(page, client, monkeypatch, caplog):
    plain = page.queue.renderer.slices

    def slices(look, height):
        if look.width == 77:
            raise RuntimeError("cannot be\ndrawn")
        return plain(look, height)

    monkeypatch.setattr(page.queue.renderer, "slices", slices)
    hostile = page.client(width=77)
    for degrees in range(5):
        hostile.look_from(degrees)
        time.sleep(0.05)
    client.look_from(0)
    client.wait_for_height(HEIGHT)
    monkeypatch.undo()
    assert page.worker.is_alive()
    lines = [record.getMessage() for record in caplog.records if "drawn" in record.getMessage()]
    assert len(lines) == 1
    assert "\n" not in lines[0]
    hostile.look_from(50)
    hostile.wait_for(len)  # it is served again when it wishes for what can be drawn
    hostile.close()


def test_only_so_many_look_on(page):
    def all_gone():
        return not page.page.server.get_clients()

    wait(all_gone)
    crowd = [page.client() for _ in range(limits.MOST_CLIENTS)]
    for each in crowd:
        each.look_from(0)
    for each in crowd:
        each.wait_for(len)
    late = page.client()
    late.look_from(0)
    late.wait_until(lambda: any("Notification" in said["type"] for said in late.said))
    (said,) = [said["props"]["body"] for said in late.said if "Notification" in said["type"]]
    assert f"{limits.MOST_CLIENTS} people" in said
    assert not late.pictures
    for each in (*crowd, late):
        each.close()
    wait(all_gone)
    page.still_serves()


def test_half_open_connections_are_limited(page):
    lines = [socket.create_connection(("127.0.0.1", page.port)) for _ in range(limits.MOST_SOCKETS)]
    late = [socket.create_connection(("127.0.0.1", page.port)) for _ in range(20)]
    for line in late:
        line.settimeout(20)
        with contextlib.suppress(ConnectionResetError):
            assert line.recv(1) == b""
    for line in (*lines, *late):
        line.close()

    def answers():
        with contextlib.suppress(OSError, HTTPException):
            return page.get(f"/?token={page.token}")[0] == 200

    wait(answers)
    page.still_serves()


def test_only_so_many_connect(page):
    crowd = [page.client() for _ in range(limits.MOST_CONNECTIONS)]
    with pytest.raises(InvalidStatus) as caught:
        page.client()
    assert caught.value.response.status_code == 503
    for each in crowd:
        each.close()
    page.still_serves()


@pytest.mark.filterwarnings("ignore:Queued a")
def test_who_never_reads_is_let_go(page, monkeypatch):
    monkeypatch.setattr(limits, "SEND_SECONDS", 0.3)
    wait(lambda: not page.page.server.get_clients())
    lazy = page.client(width=900, height=700, reads=False)
    lazy.socket.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    lazy.look_from(0)
    wait(lambda: page.page.server.get_clients())
    (handle,) = page.page.server.get_clients().values()
    for _ in range(60):
        handle.send_file_download("noise", os.urandom(1 << 20))
        if not page.page.server.get_clients():
            break
    wait(lambda: not page.page.server.get_clients())
    page.still_serves()


def wait(true, seconds=20.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)
