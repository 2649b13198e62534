"""The page of `nerf view` while training."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.checkpoints.reading import scene_record
from nerf_lightning.errors import InputError
from nerf_lightning.training.callbacks.watcher import WHOLE_BATCH_POINTS
from nerf_lightning.viewer.admission import named_places
from nerf_lightning.viewer.page import Page, require_viser
from nerf_lightning.viewer.ports import require_address
from nerf_lightning.viewer.render_queue import RenderQueue
from nerf_lightning.viewer.renderer import SlicedRenderer
from nerf_lightning.viewer.shown_photographs import Photographs

# Steps take their time, so a picture may as well.
MOVING_SECONDS = 0.5
# How much unused time for pictures is saved up at most (seconds).
MOST_CREDIT = 0.1


class LiveView(Callback):
    """Render between steps, in the training's own thread, for whoever has the page open.

    Training does not wait for the page: pictures get a share of the time, and viser's thread sends them. Nothing that
    training reads is changed.

    Args:
        host: the address to listen on; 127.0.0.1 is heard by this machine alone.
        port: the port, or the first to try.
        share: largest part of the time that goes into pictures.
        refresh_seconds: time between two pictures of the same view.
        max_height: the finest picture, in pixels.
        hosts: names by which browsers find the page, besides 127.0.0.1, localhost and [::1]; each at the page's port
            unless it has its own, like gate.example:443.

    Raises:
        InputError: no viser, no place to listen, or a host that is none.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 8080,
        share: float = 0.15,
        refresh_seconds: float = 3.0,
        max_height: int = 480,
        hosts: Sequence[str] | None = None,
    ):
        require_viser()
        require_address(host, port)
        named_places(hosts)
        if not 0 < share < 1:
            raise InputError(f"viewer.live_view.share={share}: give a part of the time between 0 and 1, like 0.15.")
        self.host, self.port, self.hosts = host, port, hosts
        self.share, self.refresh_seconds, self.max_height = share, refresh_seconds, max_height
        self.page: Page | None = None
        self.credit, self.last, self.refreshed = 0.0, 0.0, 0.0

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        """Open the page, and say where it is."""
        if not trainer.is_global_zero:
            return
        scene = trainer.datamodule.scene  # type: ignore[attr-defined]
        renderer = SlicedRenderer(
            pl_module.model,
            scene_record(scene),
            scene.background,
            pl_module.step.tile_points or WHOLE_BATCH_POINTS,
            self.share,
            MOVING_SECONDS,
        )
        photographs = Photographs(renderer.scene, scene, scene.background)
        folder = Path(trainer.default_root_dir) / "viewer"
        where = self.host, self.port, self.max_height, self.hosts
        self.page = Page(RenderQueue(renderer), photographs, folder, *where)
        self.last = self.refreshed = time.perf_counter()
        # Its token is for this terminal: others may read train.log.
        print(f"Watch the training at {self.page.address}", flush=True)

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Render for as long as the share allows."""
        if self.page is None:
            return
        now = time.perf_counter()
        self.credit = min(MOST_CREDIT, self.credit + self.share * (now - self.last))
        self.last = now
        queue = self.page.queue
        if self.credit <= 0 or queue.is_empty:
            return
        if now - self.refreshed > self.refresh_seconds:
            self.refreshed = now
            queue.refresh()
        self._spend(pl_module, queue)

    def on_train_end(self, trainer: Trainer, pl_module: Any) -> None:
        """Close the page."""
        self._close()

    def on_exception(self, trainer: Trainer, pl_module: Any, exception: BaseException) -> None:
        """Close the page."""
        self._close()

    def _spend(self, system: Any, queue: RenderQueue) -> None:
        # A slice that took longer is paid back before the next one begins.
        system.eval()
        while self.credit > 0 and queue.work():
            now = time.perf_counter()
            self.credit -= now - self.last
            self.last = now
        system.train()

    def _close(self) -> None:
        if self.page is not None:
            self.page.close()
            self.page = None
