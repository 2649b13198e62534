"""Examine a capture before hours are spent on it: problems stop the training, doubts are logged."""

import logging
from collections.abc import Callable

from nerf_lightning.data.pixels.store import in_threads
from nerf_lightning.doctor import cameras
from nerf_lightning.doctor.check import CaptureData, Check
from nerf_lightning.doctor.examine import examine
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.types.scene import PixelStore, Scene

QUICK: dict[str, Callable[[CaptureData], Check]] = {
    "rotations": cameras.rigid,
    "camera directions": cameras.common_middle,
    "field of view": cameras.field_of_view,
    "principal point": cameras.principal_point,
    "number of views": cameras.number_of_views,
}
"""Checks that cost nothing and find problems."""
NEVER_POINTLESS = ("number of views", "split")
"""Checks that never stop a training: its result is worth something all the same."""
ROWS = 8  # Rows of a photograph that are examined first: nearly all show something there
SPREAD = 3  # Levels of 255 that a single one becomes in a JPEG

log = logging.getLogger(__name__)


def require_sound(scene: Scene) -> list[Check]:
    """Examine a scene and return the outcome of each check; takes seconds."""
    _, checks = examine(scene)
    for check in checks:
        if check.verdict == "look" or (check.verdict == "wrong" and check.name in NEVER_POINTLESS):
            log.warning("doctor: %s: %s. %s", check.name, check.message, check.cure)
    wrong = [check for check in checks if check.verdict == "wrong" and check.name not in NEVER_POINTLESS]
    if wrong:
        first, others = wrong[0], ", ".join(check.name for check in wrong[1:])
        raise InputError(
            f"The capture {scene.name} cannot be trained "
            f"on. {first.name}: {first.message}. {first.cure}{f' Also wrong: {others}.' if others else ''} nerf doctor "
            "shows all findings, with a figure; doctor=off trains anyway."
        )
    unknown = [check.name for check in checks if check.verdict == "not judged"]
    left = f"; not judged: {', '.join(unknown)}" if unknown else ""
    count = len(checks) - len(unknown)
    log.info("doctor: %d checks found no problem%s (doctor=off skips all checks)", count, left)
    return checks


def exposure_finding(checks: list[Check] | None) -> str | None:
    """Return what the checks say about different exposures of photographs, if anything."""
    found = [check.message for check in checks or () if check.name == "exposure" and check.verdict == "look"]
    return found[0] if found else None


def warn_of_faults(scene: Scene) -> None:
    """Warn about faults of a scene that are found instantly, whether the doctor is enabled or not."""
    train = scene.splits["train"]
    found = in_threads(lambda number: _nothing(scene.pixels, train[number]), len(train), "Looking", visible=False)
    blank = [f"{scene.view_names[view]} ({what})" for view, what in zip(train, found, strict=True) if what]
    if blank:
        alpha = ", whether alpha was exported (0 is transparent)" if scene.pixels.has_transparency else ""
        masks = ", whether the masks keep the wrong side (scene.masks_keep)" if scene.pixels.mask is not None else ""
        log.warning(
            "%d of %d training photographs of %s show nothing: %s. Look whether the files do%s%s.",
            *(len(blank), len(train), scene.name, listed(blank, cap=5), alpha, masks),
        )
    for name, judge in QUICK.items() if scene.capture_of is None else ():
        check = judge(CaptureData(scene))
        if check.verdict == "wrong":
            log.warning("%s: %s. %s", name, check.message, check.cure)


def _nothing(pixels: PixelStore, view: int) -> str | None:
    """Return what replaces a picture: one color, or nothing at all; None if it is a picture."""
    rgba, kept = pixels.view(view), pixels.view_mask(view)
    for step in (max(1, len(rgba) // ROWS), 1):
        part = rgba[::step].reshape(-1, 4) if kept is None else rgba[::step][kept[::step]]
        seen = part[part[:, 3] > 0, :3]
        if len(seen) and int((seen.amax(dim=0) - seen.amin(dim=0)).max()) > SPREAD:
            return None
    return f"all {', '.join(map(str, seen[0].tolist()))}" if len(seen) else "transparent"
