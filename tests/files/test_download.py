import hashlib
import http.server
import re
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
    """Serve one file; count how often it was asked for."""

    content = CONTENT
    sends_at_most = NUM_BYTES * 2
    status_for_all = 0

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.asked = 0
        self.url = f"http://127.0.0.1:{self.server_port}/file.bin"


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.server.asked += 1
        if self.server.status_for_all:
            self.send_error(self.server.status_for_all)
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(self.server.content)))
        self.end_headers()
        self.wfile.write(self.server.content[: self.server.sends_at_most])

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


def refused(url, target, reason, num_bytes=NUM_BYTES, sha256=SHA256):
    cure = (
        rf"Run again to try once more, or get the file \({num_bytes} bytes\) from that address by hand "
        rf"and put it at {re.escape(str(target))}\.$"
    )
    with pytest.raises(InputError, match=rf"^Could not download {re.escape(url)}: .*{reason}.*\. {cure}"):
        fetch(url, target, num_bytes, sha256)
    assert not target.exists()


def test_brings_the_file_leaves_no_part_and_does_not_fetch_it_again(server, target):
    fetch(server.url, target, NUM_BYTES, SHA256)
    assert target.read_bytes() == CONTENT
    assert {path.name for path in target.parent.iterdir()} <= {"file.bin", "file.bin.lock"}
    target.write_bytes(b"mine")
    fetch(server.url, target, NUM_BYTES, SHA256)
    assert (target.read_bytes(), server.asked) == (b"mine", 1)


def test_two_at_a_time_fetch_once(server, target):
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda _: fetch(server.url, target, NUM_BYTES, SHA256), range(2)))
    assert (target.read_bytes(), server.asked) == (CONTENT, 1)


def test_another_file_half_of_it_and_one_that_is_absent_are_told(server, target):
    refused(server.url, target, rf"its checksum is {SHA256}, not abc", sha256="abc")
    refused(server.url, target, r"should have 99 bytes, but 100 came", num_bytes=99)
    server.sends_at_most = 100_000
    refused(server.url, target, r"should have 307200 bytes, but 100000 came|IncompleteRead")
    server.status_for_all = 404
    refused(server.url, target, "HTTP Error 404: Not Found")


def test_a_port_that_nobody_serves_and_a_folder_that_cannot_be_made_are_told(monkeypatch, target, tmp_path):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}/file.bin"
    refused(url, target, r"refused")
    (tmp_path / "file").touch()
    refused("https://example.invalid/a", tmp_path / "file" / "a", "exists")


@pytest.mark.parametrize("url", ["http://example.invalid/a", "ftp://example.invalid/a", "file:///etc/hosts", "a"])
def test_only_https_is_trusted_without_a_checksum_and_http_with_one(target, url):
    refused(url, target, "is not an https address, which is needed without a checksum", sha256=None)
    if not url.startswith("http"):
        refused(url, target, "is not an https address")


def test_the_npz_reader_fetches_what_is_absent(server, tmp_path):
    server.content = write_npz(tmp_path / "there.npz").read_bytes()
    download = {"url": server.url, "bytes": len(server.content), "sha256": None}
    for _ in range(2):
        assert NpzReader(str(tmp_path / "here.npz"), download=download).read().splits["val"] == (8, 9)
    assert server.asked == 1
