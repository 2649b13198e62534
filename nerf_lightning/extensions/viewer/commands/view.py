"""Explore a trained scene in the browser."""

from threading import Thread

from omegaconf import DictConfig

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.config.open_checkpoint import open_checkpoint, read_photographs, scene_to_look_at
from nerf_lightning.data.captures.checks import known_background
from nerf_lightning.extensions.viewer.guarded_server import Auth
from nerf_lightning.extensions.viewer.page import Page, require_viser
from nerf_lightning.extensions.viewer.ports import tunnel
from nerf_lightning.extensions.viewer.render_queue import RenderQueue, received_stop_signals
from nerf_lightning.extensions.viewer.renderer import SlicedRenderer
from nerf_lightning.extensions.viewer.shown_photographs import Photographs
from nerf_lightning.messages.console import say
from nerf_lightning.runs.command_folder import beside_checkpoint, chosen_folder


def run(config: DictConfig) -> None:
    """Serve the page until Ctrl-C or SIGTERM."""
    require_viser()
    auth = Auth(config.host, config.viewer.hosts)
    opened = open_checkpoint(config)
    record, scene = opened.checkpoint.scene, None
    if opened.model.needs_photographs:
        scene = scene_to_look_at(opened, config.scene if config.photographs else None)
        record = scene_record(scene)
    background = known_background(config.background or record.background)
    # Made when a user saves something: a checkpoint may be in a read-only place.
    folder = chosen_folder(config.paths.output_dir, beside_checkpoint(opened.checkpoint.path, "viewer"))
    renderer = SlicedRenderer(opened.model, record, background, opened.tile_points)
    renderer.warm_up()
    queue = RenderQueue(renderer)
    photographs = Photographs(record, scene, background)
    exports = beside_checkpoint(opened.checkpoint.path, "export")
    run_folder = exports.parent
    page = Page(queue, photographs, folder, auth, config.port, config.max_height, exports=exports, run=run_folder)
    stopped = received_stop_signals()
    say(f"The viewer is at {page.address} (Ctrl-C stops it)", *tunnel(page.address))
    if config.photographs and scene is None:  # large ones take long, and the page does not need them to start
        Thread(target=lambda: photographs.take(read_photographs(config, opened)), daemon=True).start()
    try:
        while not stopped:
            queue.work_or_wait()
    finally:
        page.close()
