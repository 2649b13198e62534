"""A page in this process, over a ball, and whoever calls on it."""

import http.client
import socket
import threading
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from support.ports import unused_port
from support.scenes import ball_scene, tiny_model
from support.viser_client import ViserClient

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.extensions.viewer.guarded_server import Auth
from nerf_lightning.extensions.viewer.page import Page
from nerf_lightning.extensions.viewer.render_queue import RenderQueue
from nerf_lightning.extensions.viewer.renderer import SlicedRenderer
from nerf_lightning.extensions.viewer.shown_photographs import Photographs

HEIGHT = 24


@dataclass
class ServedPage:
    """The page, the queue that draws for it, and where it is."""

    page: Page
    queue: RenderQueue
    worker: threading.Thread

    @property
    def address(self) -> str:
        return self.page.address

    @property
    def port(self) -> int:
        return self.page.server.get_port()

    @property
    def token(self) -> str:
        return parse_qs(urlsplit(self.address).query).get("token", ["none"])[0]

    def client(self, width: int = 32, height: int = HEIGHT, **handshake) -> ViserClient:
        return ViserClient(self.address, width, height, **handshake)

    def as_host(self, name: str, **handshake) -> ViserClient:
        """Call on the page under another name, as a browser whose DNS was deceived does."""
        line = socket.create_connection(("127.0.0.1", self.port))
        return ViserClient(f"http://{name}/?token={self.token}", sock=line, **handshake)

    def get(self, path: str, **headers: str) -> tuple[int, dict[str, str], str]:
        """Return status, headers and text of a page."""
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)) as connection:
            connection.request("GET", path, headers=headers)
            response = connection.getresponse()
            return response.status, dict(response.getheaders()), response.read().decode("utf-8", "replace")

    def still_serves(self) -> None:
        """Expect a picture, for somebody who comes now."""
        client = self.client()
        client.look_from(10)
        client.wait_for(lambda pictures: any(len(each) == HEIGHT for each in pictures), seconds=20)
        client.close()
        assert self.worker.is_alive()


@contextmanager
def served(folder: Path, record: dict | None = None, model=None, scene=None, height: int = HEIGHT, hosts=(), **options):
    """Serve a page until the end of the block; `record` changes what the checkpoint says of the capture.

    `scene` has the photographs, which are not at hand otherwise.
    """
    record = replace(scene_record(scene or ball_scene(num_views=4, size=16)), **(record or {}))
    queue = RenderQueue(SlicedRenderer(model or tiny_model().eval(), record, "white", 4096))
    auth = Auth("127.0.0.1", hosts)
    page = Page(queue, Photographs(record, scene, "white"), folder, auth, unused_port(), height, **options)
    over = threading.Event()

    def work() -> None:
        while not over.is_set():
            queue.work_or_wait(0.02)

    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    try:
        yield ServedPage(page, queue, worker)
    finally:
        over.set()
        worker.join()
        page.close()
