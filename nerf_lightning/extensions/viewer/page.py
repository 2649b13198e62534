"""The page in the browser: viser's server, and a session for each user."""

import math
import warnings
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from nerf_lightning.extensions.viewer.camera_state import fov_that_holds, point_ahead
from nerf_lightning.extensions.viewer.client import ViewerClient
from nerf_lightning.extensions.viewer.controls import MOST_DEGREES, Controls
from nerf_lightning.extensions.viewer.guarded_server import Auth, guarded_server
from nerf_lightning.extensions.viewer.ports import address_of, free_port
from nerf_lightning.extensions.viewer.render_queue import RenderQueue
from nerf_lightning.extensions.viewer.shown_photographs import Photographs
from nerf_lightning.extensions.viewer.training_switch import TrainingSwitch
from nerf_lightning.messages.errors import require_extra
from nerf_lightning.nerf.geometry.cameras import vertical_field_of_view
from nerf_lightning.nerf.geometry.world_frame import central_view
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.runs.summary import scene_of_run
from nerf_lightning.video.paths.base import frame_of


def require_viser() -> Any:
    """Return viser, or report how to install it."""
    return require_extra("viser", "viewer", "The viewer")


class Page:
    """Listen, and serve each user their own picture.

    Args:
        queue: renders; the owner of the page calls its `work`.
        photographs: of the capture, for frusta and comparison.
        folder: where snapshots and camera paths are written.
        auth: checks who may access the page, and defines where it listens.
        port: the port, or the first to try.
        most_height: height of the finest image, in pixels.
        training: controls for the training that the page shows; None: no training.
        exports: folder of files that users can download; None: none.
        run: the run's folder, which may name the scene; None: the capture's own name is the title.
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
        run: Path | None = None,
    ) -> None:
        require_viser()
        self.queue, self.photographs, self.folder, self.auth = queue, photographs, folder, auth
        self.most_height, self.training, self.exports = most_height, training, exports
        record = photographs.record
        self.first = central_view(record)
        self.around = frame_of(record.cameras, record.aabb, to_user=record.to_user)
        # Pages may be closed while a picture is being sent; that needs no warning.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        title = record.name if run is None else scene_of_run(record.name, run)
        self.server = guarded_server(auth, free_port(auth.host, port), title)
        self.server.gui.set_panel_label(title)
        self._dress(record)
        self.server.on_client_connect(queue.errors.harmless(self._welcome))
        self.server.on_client_disconnect(queue.errors.harmless(lambda client: queue.remove(client.client_id)))

    @property
    def address(self) -> str:
        """The address of the page, which contains the token."""
        place = address_of(self.server.get_host(), self.server.get_port())
        return f"{place}/?token={self.auth.token}"

    @property
    def is_empty(self) -> bool:
        """Whether no user is connected."""
        return not self.server.get_clients()

    def close(self) -> None:
        """Stop listening; open pages report that the connection is lost."""
        with redirect_stdout(StringIO()):  # viser reports it, too
            self.server.stop()

    def _dress(self, record: SceneRecord) -> None:
        # The share button would send everything through a third-party server.
        self.server.gui.configure_theme(show_share_button=False, show_logo=False)
        self.server.scene.set_up_direction(tuple(self.around.up.tolist()))
        start = self.server.initial_camera
        c2w = record.cameras.c2w[self.first]
        start.position, start.look_at = tuple(c2w[:, 3].tolist()), tuple(point_ahead(c2w, self.around).tolist())
        start.fov = vertical_field_of_view(record.cameras, self.first)
        start.near, start.far = 0.01 * self.around.radius, 100 * self.around.radius

    def _welcome(self, client: Any) -> None:
        camera = client.camera
        fov = camera.fov = self._first_fov(max(1, camera.image_width) / max(1, camera.image_height))
        session = ViewerClient(client, self.queue, self.photographs, self.around, self.most_height)
        session.start()  # the first picture is rendered while the panel is built
        # The browser may have sent its old field of view once more before it received this one.
        Controls(session, self.folder, fov, self.training, self.exports)
        # A user who has left in the meantime may have been removed before being added.
        if client.client_id not in self.server.get_clients():
            self.queue.remove(client.client_id)

    def _first_fov(self, window: float) -> float:
        """Return the initial field of view: that of the photograph it starts at, in any window."""
        cameras = self.photographs.record.cameras
        panorama = cameras.lens_model == "equirectangular"
        shape = 1.0 if panorama else int(cameras.width[self.first]) / int(cameras.height[self.first])
        widest = math.radians(MOST_DEGREES)
        return min(fov_that_holds(vertical_field_of_view(cameras, self.first), shape, window), widest)
