import hashlib
import http.server
import re
import shutil
import socket
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from support.captures import write_npz

from nerf_lightning.data.readers.npz import NpzReader
from nerf_lightning.files.download import fetch
from nerf_lightning.messages.errors import InputError

CONTENT = bytes(range(256)) * 1200
NUM_BYTES = len(CONTENT)
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Server(http.server.ThreadingHTTPServer):
    """Serve one file; remember the ranges that were asked for."""

    content = CONTENT
    takes_ranges = True
    sends_at_most = NUM_BYTES * 2
    status_for_all = 0

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.asked = []
        self.url = f"http://127.0.0.1:{self.server_port}/file.bin"


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        asked = self.headers["Range"]
        self.server.asked.append(asked)
        content, start = self.server.content, 0
        if self.server.status_for_all:
            self.send_error(self.server.status_for_all)
            return
        if asked and self.server.takes_ranges:
            start = int(re.fullmatch(r"bytes=(\d+)-", asked).group(1))
            if start >= len(content):
                self.send_error(416)
                return
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        else:
            self.send_response(200)
        self.send_header("Content-Length", str(len(content) - start))
        self.end_headers()
        self.wfile.write(content[start:][: self.server.sends_at_most])

    def log_message(self, *args):
        pass


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def target(tmp_path):
    return tmp_path / "folder" / "file.bin"


@pytest.fixture
def part(target):
    target.parent.mkdir()
    return target.with_name("file.bin.part")


def refused(url, target, reason, num_bytes=NUM_BYTES, sha256=SHA256):
    cure = (
        rf"Run again to try once more, or get the file \({num_bytes} bytes\) from that address by hand "
        rf"and put it at {re.escape(str(target))}\.$"
    )
    with pytest.raises(InputError, match=rf"^Could not download {re.escape(url)}: .*{reason}.*\. {cure}"):
        fetch(url, target, num_bytes, sha256)
    assert not target.exists()


def test_brings_the_file_and_leaves_no_part_nor_fetches_it_again(server, target):
    fetch(server.url, target, NUM_BYTES, SHA256)
    assert target.read_bytes() == CONTENT
    assert not target.with_name("file.bin.part").exists()
    target.write_bytes(b"mine")
    fetch(server.url, target, NUM_BYTES, SHA256)
    assert (target.read_bytes(), server.asked) == (b"mine", [None])


@pytest.mark.parametrize(
    ("there", "takes_ranges", "asked"),
    [
        (CONTENT[:1000], True, ["bytes=1000-"]),
        (CONTENT[:1000], False, ["bytes=1000-"]),  # starts over
        (CONTENT, True, []),  # checked without the network
        (CONTENT + b"more", True, [None]),  # dropped
    ],
)
def test_goes_on_from_the_part_or_starts_over(server, target, part, there, takes_ranges, asked):
    server.takes_ranges = takes_ranges
    part.write_bytes(there)
    fetch(server.url, target, NUM_BYTES, SHA256)
    assert (target.read_bytes(), server.asked) == (CONTENT, asked)


def test_a_broken_connection_keeps_what_came_and_goes_on_later(server, target):
    server.sends_at_most = 100_000
    refused(server.url, target, r"the connection broke off after 100000 of 307200 bytes, which are kept in")
    server.sends_at_most = NUM_BYTES
    fetch(server.url, target, NUM_BYTES, SHA256)
    assert target.read_bytes() == CONTENT
    assert server.asked == [None, "bytes=100000-"]


def test_two_at_a_time_fetch_once(server, target):
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda _: fetch(server.url, target, NUM_BYTES, SHA256), range(2)))
    assert (target.read_bytes(), server.asked) == (CONTENT, [None])


def test_a_wrong_checksum_a_longer_file_and_one_that_is_absent_are_told(server, target):
    refused(server.url, target, rf"its checksum is {SHA256}, not abc; what arrived was removed", sha256="abc")
    assert not target.with_name("file.bin.part").exists()
    refused(server.url, target, r"file has not 99 bytes: 65536 had arrived when it was stopped", num_bytes=99)
    assert not target.with_name("file.bin.part").exists()
    server.status_for_all = 404
    refused(server.url, target, "the server answered 404 Not Found")


def test_file_that_is_shorter_than_the_part(server, target, part):
    part.write_bytes(CONTENT + b"beyond")
    refused(server.url, target, "the server answered 416", num_bytes=NUM_BYTES * 2)
    assert not part.exists()


def test_unreachable_port(monkeypatch, target):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}/file.bin"
    refused(url, target, r"no connection \(.*refused")


@pytest.mark.parametrize("url", ["http://example.invalid/a", "ftp://example.invalid/a", "file:///etc/hosts", "a"])
def test_only_https_is_trusted_without_a_checksum_and_http_with_one(target, url):
    refused(url, target, "is not an https address, and without a checksum nothing else is trusted", sha256=None)
    if not url.startswith("http"):
        refused(url, target, "is not an https address")


def test_no_room_on_the_disk_and_a_folder_that_cannot_be_made_are_told(monkeypatch, target, tmp_path):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10, 5, 5))
    refused("https://example.invalid/a", target, r"has 5 bytes free, but 307200 more are needed")
    monkeypatch.undo()
    (tmp_path / "file").touch()
    refused("https://example.invalid/a", tmp_path / "file" / "a", "exists")


def test_the_npz_reader_fetches_what_is_absent(server, tmp_path):
    server.content = write_npz(tmp_path / "there.npz").read_bytes()
    download = {"url": server.url, "bytes": len(server.content), "sha256": None}
    for _ in range(2):
        assert NpzReader(str(tmp_path / "here.npz"), download=download).read().splits["val"] == (8, 9)
    assert server.asked == [None]
