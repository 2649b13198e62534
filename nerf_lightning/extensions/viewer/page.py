"""The page in the browser: viser's server, and a session for everybody who opens it."""

import math
import warnings
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from nerf_lightning.extensions.viewer.camera_state import fov_that_holds
from nerf_lightning.extensions.viewer.client import ViewerClient
from nerf_lightning.extensions.viewer.controls import MOST_DEGREES, Controls
from nerf_lightning.extensions.viewer.guarded_server import Auth, guarded_server
from nerf_lightning.extensions.viewer.ports import address_of, free_port
from nerf_lightning.extensions.viewer.render_queue import RenderQueue
from nerf_lightning.extensions.viewer.shown_photographs import Photographs
from nerf_lightning.extensions.viewer.training_switch import TrainingSwitch
from nerf_lightning.messages.errors import require_extra
from nerf_lightning.nerf.geometry.cameras import vertical_field_of_view
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.video.paths.base import frame_of

# The view begins this many times as far from the middle as the first photograph: behind the cameras, not among them.
START = 1.4


def require_viser() -> Any:
    """Return viser, or say how it is installed."""
    return require_extra("viser", "viewer", "The viewer")


class Page:
    """Listen, and serve everybody a picture of their own.

    Args:
        queue: renders; whoever owns the page calls its `work`.
        photographs: of the capture, for frusta and comparison.
        folder: where snapshots and camera paths are written.
        auth: judges who may speak to the page, and says where it listens.
        port: the port, or the first to try.
        most_height: height of the finest image, in pixels.
        training: what the page may ask of the training that it shows; None: it shows none.
        exports: folder of files that people can download; None: none.
    """

    def __init__(
        self,
        queue: RenderQueue,
        photographs: Photographs,
        folder: Path,
        auth: Auth,
        port: int,
        most_height: int,
        training: TrainingSwitch | None = None,
        exports: Path | None = None,
    ) -> None:
        require_viser()
        self.queue, self.photographs, self.folder, self.auth = queue, photographs, folder, auth
        self.most_height, self.training, self.exports = most_height, training, exports
        record = photographs.record
        self.around = frame_of(record.cameras, record.aabb, to_user=record.to_user)
        # Pages are closed while a picture is on its way to them; that needs no warning.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        self.server = guarded_server(auth, free_port(auth.host, port))
        self._dress(record)
        self.server.on_client_connect(queue.errors.harmless(self._welcome))
        self.server.on_client_disconnect(queue.errors.harmless(lambda client: queue.remove(client.client_id)))

    @property
    def address(self) -> str:
        """Where a browser finds the page; who has this address has the token."""
        place = address_of(self.server.get_host(), self.server.get_port())
        return f"{place}/?token={self.auth.token}"

    @property
    def is_empty(self) -> bool:
        """Whether nobody looks on."""
        return not self.server.get_clients()

    def close(self) -> None:
        """Stop listening; open pages say that the connection is lost."""
        with redirect_stdout(StringIO()):  # viser says so, too
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
        camera = client.camera
        fov = camera.fov = self._first_fov(max(1, camera.image_width) / max(1, camera.image_height))
        session = ViewerClient(client, self.queue, self.photographs, self.around, self.most_height)
        session.start()  # the first picture is on its way while the panel is made
        # The browser may have said once more what its field was, before it heard of this one.
        Controls(session, self.folder, fov, self.training, self.exports)
        # Who has left meanwhile may have been seen off before being here.
        if client.client_id not in self.server.get_clients():
            self.queue.remove(client.client_id)

    def _first_fov(self, window: float) -> float:
        """Return the field of view that begins: what the first photograph takes in, in a window of any shape."""
        cameras = self.photographs.record.cameras
        panorama = cameras.lens_model == "equirectangular"
        shape = 1.0 if panorama else int(cameras.width[0]) / int(cameras.height[0])
        widest = math.radians(MOST_DEGREES)
        return min(fov_that_holds(vertical_field_of_view(cameras, 0), shape, window), widest)
