"""The page in the browser: viser's server, and a session for everybody who opens it."""

import logging
import math
import threading
import warnings
import webbrowser
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import vertical_field_of_view
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.video.paths.base import frame_of
from nerf_lightning.viewer import limits
from nerf_lightning.viewer.admission import Admission
from nerf_lightning.viewer.camera_state import fov_that_holds
from nerf_lightning.viewer.client import ViewerClient
from nerf_lightning.viewer.controls import MOST_DEGREES, Controls
from nerf_lightning.viewer.ports import free_port
from nerf_lightning.viewer.render_queue import RenderQueue
from nerf_lightning.viewer.shown_photographs import Photographs
from nerf_lightning.viewer.training_switch import TrainingSwitch

# The view begins this many times as far from the middle as the first photograph: behind the cameras, not among them.
START = 1.4
FULL = (
    f"{limits.MOST_CLIENTS} people look on already, and more are not drawn for: close a page, then load this one again."
)

log = logging.getLogger(__name__)


def require_viser() -> Any:
    """Return viser.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module("viser")
    except ImportError as error:
        raise InputError(
            "The viewer needs viser, which is not installed or does not load here "
            f"({error}). Install it with: pip install 'nerf-lightning[viewer]'"
        ) from error


class Page:
    """Listen, and serve everybody a picture of their own.

    Args:
        queue: renders; whoever owns the page calls its `work`.
        photographs: of the capture, for frusta and comparison.
        folder: where snapshots and camera paths are written.
        host: the address to listen on; 127.0.0.1 is heard by this machine alone.
        port: the port, or the first to try.
        most_height: the finest picture, in pixels.
        hosts: names by which browsers find the page, besides 127.0.0.1, localhost and [::1].
        training: what the page may ask of the training that it shows; None: it shows none.

    Raises:
        InputError: no viser, or one that cannot be guarded; no place to listen; a host that is none.
    """

    def __init__(
        self,
        queue: RenderQueue,
        photographs: Photographs,
        folder: Path,
        host: str,
        port: int,
        most_height: int,
        hosts: Sequence[str] | None = None,
        training: TrainingSwitch | None = None,
    ) -> None:
        viser = require_viser()
        from nerf_lightning.viewer.guarded_server import Guard

        self.queue, self.photographs, self.folder = queue, photographs, folder
        self.most_height, self.training = most_height, training
        record = photographs.record
        self.around = frame_of(record.cameras, record.aabb, to_user=record.to_user)
        # Pages are closed while a picture is on its way to them; that needs no warning.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        self.admission = Admission(host, hosts)
        guard = Guard(self.admission, queue.complaints)
        with _quietly(), guard.in_place():
            self.server = viser.ViserServer(host, free_port(host, port), label="nerf_lightning", verbose=False)
        if not guard.is_in_place:
            self.close()
            guard.require_in_place()
        self._dress(record)
        self._seats: set[int] = set()
        self._lock = threading.Lock()
        self.server.on_client_connect(queue.complaints.harmless(self._welcome))
        self.server.on_client_disconnect(queue.complaints.harmless(self._take_leave))

    @property
    def address(self) -> str:
        """Where a browser finds the page; who has this address has the token."""
        place = address_of(self.server.get_host(), self.server.get_port())
        return f"{place}/?token={self.admission.token}"

    @property
    def is_empty(self) -> bool:
        """Whether nobody looks on."""
        return not self._seats

    def close(self) -> None:
        """Stop listening; open pages say that the connection is lost."""
        with _quietly():
            self.server.stop()

    def _dress(self, record: SceneRecord) -> None:
        # The share button would send everything through somebody else's server.
        self.server.gui.configure_theme(show_share_button=False, show_logo=False)
        self.server.scene.set_up_direction(tuple(self.around.up.tolist()))
        start = self.server.initial_camera
        first, center = record.cameras.c2w[0, :, 3], self.around.center
        # Forward-facing captures show nothing to who stands behind their near plane's cameras.
        farther = START if record.space == "bounded" else 1.0
        start.position = tuple((center + farther * (first - center)).tolist())
        start.look_at = tuple(center.tolist())
        start.fov = vertical_field_of_view(record.cameras, 0)
        start.near, start.far = 0.01 * self.around.radius, 100 * self.around.radius

    def _welcome(self, client: Any) -> None:
        if not self._has_seat(client.client_id):
            client.add_notification("Full", FULL, color="red")
            return
        fov = client.camera.fov = self._first_fov(client.camera.image_width / client.camera.image_height)
        session = ViewerClient(client, self.queue, self.photographs, self.around, self.most_height)
        session.start()  # the first picture is on its way while the panel is made
        # The browser may have said once more what its field was, before it heard of this one.
        Controls(session, self.folder, fov, self.training)
        # Who has left meanwhile may have been seen off before being here.
        if client.client_id not in self.server.get_clients():
            self._take_leave(client)

    def _first_fov(self, window: float) -> float:
        """Return the field of view that begins: what the first photograph takes in, in a window of any shape."""
        cameras = self.photographs.record.cameras
        panorama = cameras.lens_model == "equirectangular"
        shape = 1.0 if panorama else int(cameras.width[0]) / int(cameras.height[0])
        widest = math.radians(MOST_DEGREES)
        return min(fov_that_holds(vertical_field_of_view(cameras, 0), shape, window), widest)

    def _has_seat(self, client: int) -> bool:
        with self._lock:
            if len(self._seats) >= limits.MOST_CLIENTS:
                return False
            self._seats.add(client)
            return True

    def _take_leave(self, client: Any) -> None:
        self.queue.remove(client.client_id)
        with self._lock:
            self._seats.discard(client.client_id)


def address_of(host: str, port: int) -> str:
    """Return where a browser on this machine finds what listens there.

    >>> address_of("0.0.0.0", 80), address_of("::", 80), address_of("fd00::2", 80)
    ('http://127.0.0.1:80', 'http://[::1]:80', 'http://[fd00::2]:80')
    """
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def open_in_browser(address: str) -> None:
    """Open a page in the user's browser, or say why not."""
    try:
        opened = webbrowser.open(address)
    except webbrowser.Error:
        opened = False
    if not opened:
        log.warning(
            "There is no browser here to open. Open %s in one yourself; from another machine, first forward the port: "
            "ssh -L %s:%s THIS_MACHINE.",
            address,
            urlsplit(address).port,
            urlsplit(address).netloc,
        )


class _quietly:
    """Keep viser's boxes off the terminal: it prints through rich's global console."""

    def __enter__(self) -> None:
        from rich import get_console

        self.console = get_console()
        self.was, self.console.quiet = self.console.quiet, True

    def __exit__(self, *error: object) -> None:
        self.console.quiet = self.was
