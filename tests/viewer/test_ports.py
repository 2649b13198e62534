"""A port that is taken gives its place to the next; what cannot be is said."""

import logging
import socket

import pytest

from nerf_lightning.messages.errors import InputError
from nerf_lightning.viewer import ports
from nerf_lightning.viewer.ports import free_port


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


def test_an_address_that_is_not_this_machines_is_named():
    with pytest.raises(InputError, match=r"host=192\.0\.2\.1: this machine cannot listen there"):
        free_port("192.0.2.1", 8080)


@pytest.mark.parametrize("port", [0, -1, 70_000])
def test_a_port_that_is_none_is_named(port):
    with pytest.raises(InputError, match=f"port={port}: give a number"):
        free_port("127.0.0.1", port)
