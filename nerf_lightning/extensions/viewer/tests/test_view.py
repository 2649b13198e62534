"""`nerf view`: the page serves pictures, in a real browser too, and ends cleanly."""

import re
import signal
import socket
from contextlib import contextmanager
from dataclasses import dataclass
from subprocess import Popen
from urllib.parse import urlsplit

import numpy as np
import pytest
from support.browser import drag, opened, wait_until
from support.planted import write_checkpoint
from support.ports import unused_port
from support.running import said, start
from support.viser_client import ViserClient

from nerf_lightning.cli.prepare import prepared
from nerf_lightning.extensions.viewer.commands import view
from nerf_lightning.messages import errors
from nerf_lightning.messages.errors import InputError


@dataclass
class Served:
    process: Popen
    address: str
    said: str

    @property
    def port(self):
        return urlsplit(self.address).port


def serve(*arguments):
    """Start `nerf view` and wait until it says where the page is."""
    process = start("view", *arguments)
    lines = ""
    for line in process.stdout:
        lines += line
        found = re.search(r"The viewer is at (http://\S+)", line)
        if found:
            return Served(process, found[1], lines)
    raise AssertionError(lines)


@pytest.fixture(scope="module")
def page(finished_run, tmp_path_factory):
    with served(finished_run, tmp_path_factory.mktemp("viewer")) as page:
        yield page


@contextmanager
def served(run, folder):
    checkpoint = run / "checkpoints" / "last.ckpt"
    page = serve(f"ckpt={checkpoint}", f"port={unused_port()}", "max_height=96", f"paths.output_dir={folder}")
    yield page
    page.process.kill()
    page.process.communicate()


@pytest.fixture
def client(page):
    client = ViserClient(page.address)
    yield client
    client.close()


@pytest.mark.slow
def test_a_client_sees_coarse_then_fine_pictures_and_those_that_leave_or_never_read_harm_nobody(client, page):
    client.look_from(0)
    fine = client.wait_for_height(96)
    assert len(client.pictures[0]) <= 96
    assert fine.std() > 5
    before = len(client.pictures)
    client.look_from(90)
    other = client.wait_for_height(96, after=before)
    assert np.abs(fine.astype(float) - other).mean() > 1
    slow = ViserClient(page.address, reads=False)
    for degrees in range(20):
        slow.look_from(degrees)
    gone = ViserClient(page.address)
    gone.look_from(30)
    gone.close()
    client.look_from(60)
    client.wait_for_height(96)
    slow.close()
    before = len(client.pictures)
    client.look_from(61)
    client.wait_for_height(96, after=before)
    assert page.process.poll() is None


@pytest.mark.slow
def test_ctrl_c_ends_it_and_frees_the_port(finished_run, tmp_path):
    checkpoint = finished_run / "checkpoints" / "last.ckpt"
    served = serve(f"ckpt={checkpoint}", f"port={unused_port()}", f"paths.output_dir={tmp_path}", "photographs=false")
    client = ViserClient(served.address)
    client.look_from(0)
    client.wait_for(len)
    served.process.send_signal(signal.SIGINT)
    output, _ = served.process.communicate(timeout=60)
    assert served.process.returncode == 0, output
    assert "Traceback" not in output
    with socket.socket() as again:
        again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        again.bind(("127.0.0.1", served.port))


@pytest.mark.minutes
def test_a_real_browser_shows_the_scene_turns_it_and_survives_a_reload(train, tmp_path):
    assert train("trainer.max_steps=200").code == 0  # the central photograph shows fog after 20
    with served(tmp_path / "run", tmp_path / "views") as page, opened(page.address) as browser:
        first = wait_until(browser, lambda picture: picture.std() > 10)
        drag(browser, 120, 30)
        moved = wait_until(browser, lambda picture: np.abs(picture - first).mean() > 3)
        assert moved.std() > 10
        browser.refresh()
        wait_until(browser, lambda picture: picture.std() > 10)
        assert browser.title == "ball"


def test_without_viser_there_is_one_paragraph(finished_run, nerf, monkeypatch):
    def missing(name):
        raise ImportError(f"No module named '{name}'")

    monkeypatch.setattr(errors, "import_module", missing)
    said(
        nerf("view", f"ckpt={finished_run}/checkpoints/last.ckpt"),
        "needs viser, which is not installed",
        "pip install '.[viewer]'",
    )


def test_a_place_to_listen_that_is_none_is_said(finished_run, nerf, tmp_path):
    checkpoint = finished_run / "checkpoints" / "last.ckpt"
    arguments = [f"ckpt={checkpoint}", f"paths.output_dir={tmp_path}", "photographs=false"]
    said(nerf("view", *arguments, "port=0"), "port=0: give a number from 1 to 65535")
    said(nerf("view", *arguments, "host=192.0.2.1"), "host=192.0.2.1: this machine cannot listen there")
    said(nerf("view", *arguments, "viewer.hosts=['a b']"), "viewer.hosts: 'a b' is not the name of a machine")


@pytest.fixture
def folder_of_page(monkeypatch):
    """Where the page would write; it is not opened."""
    folders = []

    def opened(queue, photographs, folder, *where, **options):
        folders.append(folder)
        raise KeyboardInterrupt

    monkeypatch.setattr(view, "Page", opened)
    return folders


def test_nothing_is_written_before_somebody_saves(nerf, tmp_path, folder_of_page):
    """A file in the folder's place represents everything that is not writable: root may write anywhere."""
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    checkpoint = write_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")
    (tmp_path / "run" / "viewer").write_text("")
    assert nerf("view", f"ckpt={checkpoint}", "photographs=false").code == 130
    assert folder_of_page == [tmp_path / "run" / "viewer"]
    assert (tmp_path / "run" / "viewer").read_text() == ""


def test_a_link_beside_a_checkpoint_is_refused_before_the_page_opens(nerf, tmp_path, folder_of_page):
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    checkpoint = write_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")
    (tmp_path / "run" / "viewer").symlink_to(tmp_path)
    said(nerf("view", f"ckpt={checkpoint}", "photographs=false"), "is a symbolic link to")
    assert folder_of_page == []


@pytest.fixture
def of_unknown_scene(tmp_path):
    return write_checkpoint(tmp_path / "x.ckpt", lambda content: content["nerf_lightning"]["choices"].update(scene="x"))


def test_why_there_are_no_photographs_is_said_and_none_are_guessed(of_unknown_scene, caplog):
    given = [f"ckpt={of_unknown_scene}", "port=9000"]
    assert prepared("view", given) == ["photographs=false", *given]
    assert "shown without their photographs" in caplog.text
    assert "was trained on the scene 'x', which conf/scene/ lacks. Name the scene: add scene=" in caplog.text
    caplog.clear()
    with pytest.raises(InputError, match="was trained on the scene 'x'"):
        prepared("view", [f"ckpt={of_unknown_scene}", "photographs=true"])
    assert prepared("view", [f"ckpt={of_unknown_scene}", "photographs=false"])[0] == "photographs=false"
    assert not caplog.text
