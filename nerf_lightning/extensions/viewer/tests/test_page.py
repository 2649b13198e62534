"""Several users of one page: what one of them sends harms neither the page nor the others."""

import logging
import math
import socket
import time

import msgspec
import numpy as np
import pytest
from support.served_page import HEIGHT, served

from nerf_lightning.extensions.viewer import ports
from nerf_lightning.extensions.viewer.ports import free_port
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.world_frame import central_view


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with served(tmp_path_factory.mktemp("page")) as page:
        yield page


@pytest.fixture
def client(page):
    client = page.client()
    yield client
    client.close()


@pytest.mark.parametrize(
    "changed",
    [
        *({"fov": value} for value in (0, -1, math.nan, math.inf)),
        *({key: 4e8} for key in ("image_width", "image_height")),
        {"image_width": 10**9, "image_height": 10},
        {"image_width": 0, "image_height": 0},
        {"position": [math.nan] * 3},
        {"wxyz": [0.0] * 4},
    ],
)
def test_after_an_impossible_camera_the_page_draws_on(page, client, changed):
    client.look_from(0, **changed)
    client.look_from(30)
    client.wait_for_height(HEIGHT)
    assert all(max(each.shape) <= 4 * HEIGHT for each in client.pictures if len(each) == HEIGHT)
    page.still_serves()


@pytest.mark.parametrize("raw", [b"", bytes(range(256)), "a text", msgspec.msgpack.encode({"type": "NoSuchMessage"})])
def test_garbage_closes_its_client_at_most(page, client, raw):
    client.socket.send(raw)
    page.still_serves()


def test_an_error_while_drawing_for_one_ends_neither_the_page_nor_the_loop(page, client, monkeypatch, caplog):
    plain = page.queue.renderer.slices

    def slices(look, height):
        if look.width == 77:
            raise RuntimeError("cannot be\ndrawn")
        return plain(look, height)

    monkeypatch.setattr(page.queue.renderer, "slices", slices)
    other = page.client(width=77)
    for degrees in range(5):
        other.look_from(degrees)
        time.sleep(0.05)
    client.look_from(0)
    client.wait_for_height(HEIGHT)
    monkeypatch.undo()
    assert page.worker.is_alive()
    (line,) = [record.getMessage() for record in caplog.records if "drawn" in record.getMessage()]
    assert "\n" not in line
    other.look_from(50)
    other.wait_for(len)  # it is served again when it requests what can be drawn
    other.close()


def test_it_starts_where_the_exported_page_does(page):
    cameras = page.page.photographs.record.cameras
    c2w, start = cameras.c2w[central_view(page.page.photographs.record)], page.page.server.initial_camera
    assert start.position.tolist() == c2w[:, 3].tolist()
    away = start.position - start.look_at
    assert away / np.linalg.norm(away) == pytest.approx(c2w[:, 2].numpy(), abs=1e-5)


def test_who_leaves_is_seen_off(page):
    client = page.client()
    client.look_from(0)
    client.wait_for(len)
    assert not page.page.is_empty
    client.close()
    client.wait_until(lambda: page.page.is_empty and page.queue.is_empty)


@pytest.fixture
def taken():
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        yield listening.getsockname()[1]


def test_the_next_free_port_is_taken_and_said(taken, caplog):
    with caplog.at_level(logging.WARNING):
        found = free_port("127.0.0.1", taken)
    assert found > taken
    assert f"port {taken} is in use" in caplog.text
    assert str(found) in caplog.text


def test_no_port_left_is_one_paragraph(taken, monkeypatch):
    monkeypatch.setattr(ports, "TRIED", 1)
    with pytest.raises(InputError, match=f"Ports {taken} to {taken} are all in use"):
        free_port("127.0.0.1", taken)


def test_over_ssh_the_command_of_the_tunnel_follows_a_local_address(monkeypatch):
    monkeypatch.delenv("SSH_CONNECTION", raising=False)
    assert not ports.tunnel("http://127.0.0.1:8081/?token=a")
    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.1 50000 10.0.0.2 22")
    assert "ssh -L 8081:127.0.0.1:8081 MACHINE" in ports.tunnel("http://127.0.0.1:8081/?token=a")[0]
    assert not ports.tunnel("http://10.0.0.2:8081/?token=a")
