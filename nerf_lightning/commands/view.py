"""Look around in a checkpoint, in the browser."""

import logging
import signal
import webbrowser
from types import FrameType
from urllib.parse import urlsplit

from omegaconf import DictConfig

from nerf_lightning.checkpoints.recorded_frame import in_recorded_frame
from nerf_lightning.config.instantiate import build
from nerf_lightning.console import say
from nerf_lightning.data.captures.checks import known_background
from nerf_lightning.errors import InputError
from nerf_lightning.nerf.types.scene import Scene, SceneRecord
from nerf_lightning.runs.output_folder import beside_checkpoint, chosen_folder
from nerf_lightning.training.open_checkpoint import open_checkpoint
from nerf_lightning.viewer.admission import named_places
from nerf_lightning.viewer.camera_state import CameraState
from nerf_lightning.viewer.page import Page, require_viser
from nerf_lightning.viewer.photographs import Photographs
from nerf_lightning.viewer.render_queue import RenderQueue
from nerf_lightning.viewer.renderer import SlicedRenderer

WARM_UP_HEIGHT = 64
IDLE_SECONDS = 0.2

log = logging.getLogger(__name__)


def run(config: DictConfig) -> None:
    """Serve the page until Ctrl-C or SIGTERM."""
    require_viser()
    named_places(config.viewer.hosts)
    opened = open_checkpoint(config)
    checkpoint = opened.checkpoint
    record = checkpoint.scene
    background = known_background(config.background or record.background)
    scene = _scene(config, record) if config.photographs else None
    # Made when somebody saves something: a checkpoint may lie where nothing can be written.
    folder = chosen_folder(config.paths.output_dir, beside_checkpoint(checkpoint.path, "viewer"))
    renderer = SlicedRenderer(opened.model, record, background, opened.tile_points)
    warm_up(renderer)
    queue = RenderQueue(renderer)
    where = config.host, config.port, config.max_height, config.viewer.hosts
    page = Page(queue, Photographs(record, scene, background), folder, *where)
    stopped = _stop_signals()
    say(f"The page is at {page.address} (Ctrl-C ends it)")
    if config.open_browser:
        open_browser(page.address)
    try:
        while not stopped:
            if not queue.work():
                queue.wait(IDLE_SECONDS)
    finally:
        page.close()


def warm_up(renderer: SlicedRenderer) -> None:
    """Render a small picture from the first photograph's place: kernels are loaded, the speed is known."""
    c2w = renderer.scene.cameras.c2w[0]
    for _ in range(2):
        for _ in renderer.slices(CameraState(c2w, 1.0, 4 * WARM_UP_HEIGHT // 3, WARM_UP_HEIGHT), WARM_UP_HEIGHT):
            pass


def open_browser(address: str) -> None:
    """Open the page in the user's browser, or say why not."""
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


def _scene(config: DictConfig, record: SceneRecord) -> Scene | None:
    try:
        return in_recorded_frame(build(config.scene).read(), record)
    except InputError as error:
        log.warning("The cameras are shown without their photographs: %s", error)
    except OSError as error:
        log.warning("The cameras are shown without their photographs, which cannot be read: %s", error)
    return None


def _stop_signals() -> list[int]:
    """Return a list that a SIGINT or SIGTERM is put into: the slice that is being rendered ends first."""
    received: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        received.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handle)
    return received
