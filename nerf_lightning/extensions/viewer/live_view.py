"""The page of `nerf view` during training."""

import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.compute import ranks
from nerf_lightning.data.captures.joined import one_capture
from nerf_lightning.extensions.viewer.guarded_server import Auth
from nerf_lightning.extensions.viewer.page import Page, require_viser
from nerf_lightning.extensions.viewer.ports import require_address, tunnel
from nerf_lightning.extensions.viewer.render_queue import RenderQueue
from nerf_lightning.extensions.viewer.renderer import SlicedRenderer
from nerf_lightning.extensions.viewer.shown_photographs import Photographs
from nerf_lightning.extensions.viewer.training_switch import TrainingSwitch
from nerf_lightning.messages.console import spoken
from nerf_lightning.messages.errors import InputError
from nerf_lightning.training.callbacks.stop_signals import StopSignals
from nerf_lightning.training.callbacks.time_budget import Clocked

# Steps take time, so a picture may, too.
MOVING_SECONDS = 0.5
# Maximum unused time for pictures that is saved up (seconds).
MOST_CREDIT = 0.1


log = logging.getLogger(__name__)


class LiveView(Callback):
    """Render between steps, in the training thread, for users who have the page open.

    Training does not wait for the page: pictures get a share of the time, and viser's thread sends them. The training
    itself is not affected.

    Args:
        host: the address to listen on: 127.0.0.1 for this machine only, 0.0.0.0 for everyone on the network.
        port: the port, or the first to try.
        share: maximum share of the time spent on rendering.
        refresh_seconds: seconds between two renders of the same view.
        max_height: height of the finest image, in pixels.
        hosts: names under which browsers reach the page, besides 127.0.0.1, localhost and [::1], such as gate.example.

    Raises:
        InputError: viser is missing, the address or port is unavailable, or a host is invalid.
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
        if not 0 < share < 1:
            raise InputError(f"viewer.live_view.share={share}: give a share of the time between 0 and 1, such as 0.15.")
        self.auth, self.port = Auth(host, hosts), port
        self.share, self.refresh_seconds, self.max_height = share, refresh_seconds, max_height
        self.page: Page | None = None
        self.credit, self.last, self.refreshed = 0.0, 0.0, 0.0
        self.switch, self.said = TrainingSwitch(), ""

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        """Open the page, and log its address."""
        if not trainer.is_global_zero:
            return
        scene = trainer.datamodule.scene  # type: ignore[attr-defined]
        if scene.capture_of is not None:
            scene = one_capture(scene, 0)  # rays without a capture belong to the first one
        renderer = SlicedRenderer(
            pl_module.model,
            scene_record(scene),
            scene.background,
            pl_module.train_step.tiles.picture_points,
            self.share,
            MOVING_SECONDS,
        )
        photographs = Photographs(renderer.scene, scene, scene.background)
        folder = Path(trainer.default_root_dir) / "viewer"
        # Other processes would wait for this one at their next step, but only for a limited time.
        self.switch = TrainingSwitch(can_pause=ranks.world_size() == 1)
        queue = RenderQueue(renderer)
        self.page = Page(
            queue, photographs, folder, self.auth, self.port, self.max_height, self.switch, run=folder.parent
        )
        self.last = self.refreshed = time.perf_counter()
        # Its token is only for this terminal: others may read train.log.
        print(f"Watch the training at {self.page.address}", *tunnel(self.page.address), sep="\n", flush=True)

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Render for as long as the share allows; pause or stop if a user of the page requested it."""
        if ranks.largest(float(self.switch.wants_stop)):
            trainer.should_stop = True
            self._say(f"training was stopped from the page at step {trainer.global_step}")
        if self.page is None:
            return
        self.switch.step, self.switch.num_steps = trainer.global_step, pl_module.train_step.num_steps
        if self.switch.wants_pause:
            self._pause(trainer, pl_module, self.page)
        now = time.perf_counter()
        self.credit = min(MOST_CREDIT, self.credit + self.share * (now - self.last))
        self.last = now
        queue = self.page.queue
        if self.credit <= 0 or queue.is_empty:
            return
        if now - self.refreshed > self.refresh_seconds:
            self.refreshed = now
            queue.refresh()
            self.switch.show()
        self._spend(pl_module, queue)

    def on_train_end(self, trainer: Trainer, pl_module: Any) -> None:
        """Close the page."""
        self._close()

    def on_exception(self, trainer: Trainer, pl_module: Any, exception: BaseException) -> None:
        """Close the page."""
        self._close()

    def _pause(self, trainer: Trainer, system: Any, page: Page) -> None:
        """Render for the users, without taking steps, until a user resumes the training."""
        self._say(f"training is paused at step {trainer.global_step}, as requested from the page")
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        signals = [each for each in callbacks if isinstance(each, StopSignals)]
        share, renderer = self.share, page.queue.renderer
        system.eval()
        self.switch.show()
        try:
            renderer.share = 1.0
            seconds = self.switch.pause_while(
                page.queue.work_or_wait,
                lambda: not page.is_empty,
                lambda: any(each.asked_to_stop() for each in signals),
            )
        finally:
            renderer.share = share
            system.train()
        for callback in callbacks:
            if isinstance(callback, Clocked):
                callback.leave_out(seconds)
        self.last = time.perf_counter()
        self._say(f"training continues after a pause of {spoken(seconds)}")

    def _say(self, text: str) -> None:
        if self.page is not None and text != self.said:
            log.info("%s", text)
            self.said = text

    def _spend(self, system: Any, queue: RenderQueue) -> None:
        # A slice that took longer delays the next one accordingly.
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
