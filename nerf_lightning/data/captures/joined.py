"""Extract one of several captures that were joined into a scene."""

import logging
from dataclasses import replace
from typing import TypeVar

import torch

from nerf_lightning.nerf.types.scene import PixelStore, Scene, SceneRecord

Record = TypeVar("Record", bound=SceneRecord)

log = logging.getLogger(__name__)


def shown_capture(scene: Record) -> Record:
    """Return the one capture to show: of several, the first that is never trained on, if any.

    Args:
        scene: of one capture, or of several joined ones; or its record.
    """
    if scene.capture_of is None:
        return scene
    trained = scene.trained_captures
    name = next((name for name in scene.captures if name not in trained), scene.captures[0])
    log.info("of the %d captures of %s, %s is shown (scene=... shows another)", len(scene.captures), scene.name, name)
    return one_capture(scene, scene.captures.index(name))


def one_capture(scene: Record, number: int) -> Record:
    """Return one of the joined captures as a scene, or a record, of its own.

    Args:
        scene: a scene whose views are of several captures (`capture_of`), or its record.
        number: index of the capture.
    """
    assert scene.capture_of is not None
    views = [view for view, capture in enumerate(scene.capture_of) if capture == number]
    place = {view: new for new, view in enumerate(views)}
    splits = {split: tuple(place[v] for v in of if v in place) for split, of in scene.splits.items()}
    splits["train"] = splits["train"] or splits.get("sources", ())
    kept = torch.tensor(views)
    some = replace(
        scene,
        name=scene.captures[number],
        cameras=scene.cameras[kept],
        near=scene.near[kept],
        far=scene.far[kept],
        splits=splits,
        view_names=tuple(scene.view_names[view] for view in views),
        capture_of=None,
        captures=(),
    )
    if isinstance(some, Scene):
        store = some.pixels
        part = {field: getattr(store, field)[kept] for field in ("offset", "width", "height")}
        return replace(
            some, pixels=PixelStore(store.rgba, **part, has_transparency=store.has_transparency, mask=store.mask)
        )
    return some
