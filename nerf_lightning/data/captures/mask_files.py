"""Match masks to photographs: by the capture's files, by scene.masks, or by a folder called masks.

How a mask's name follows from its photograph's: `named_picture` in `find_pictures.py`.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from nerf_lightning.data.captures.capture import Capture
from nerf_lightning.data.captures.find_pictures import find_pictures, pictures_below
from nerf_lightning.data.pixels.decoded_photographs import of_one_shape
from nerf_lightning.data.pixels.masks import read_mask
from nerf_lightning.data.pixels.picture_files import image_size, read_header
from nerf_lightning.files.regular import contents
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset

FOLDERS = ("masks", "mask")
MOST_READ = 4
"""Number of masks that are read from an unnamed folder to check that they are masks."""
NO_MASKS = "none"

log = logging.getLogger(__name__)


def with_masks(capture: Capture, masks: str | None, named: Path | None, folders: Sequence[Path], keeps: str) -> Capture:
    """Return the views with their masks; photographs without a mask are kept whole.

    Args:
        capture: its views may already have masks, which its files name.
        masks: the setting: a folder, none, or None for those that the files name, or else for a folder in one of
            `folders` that has one mask per photograph.
        named: the folder that the setting names, if any.
        folders: where an unnamed folder may be, the likeliest first.
        keeps: the color of kept pixels, for messages.

    Raises:
        InputError: the named folder has no masks, or there are none to which the color could apply.
    """
    found = {view.name: view.photograph.mask for view in capture.views if view.photograph.mask is not None}
    if masks == NO_MASKS:
        found = {}
    elif named is not None:
        of_setting = _masks_in(named, capture)
        if not of_setting:
            first = capture.views[0].name
            raise InputError(
                f"scene.masks={masks} holds no mask for any photograph of {capture.source}: {named} holds "
                f"{contents(named)}. A mask is named after its photograph ({first}, with .png added, or with .png or "
                "_mask.png instead of its extension)."
            )
        found |= of_setting
    elif not found:
        found = _masks_beside(folders, capture)
    views = tuple(
        replace(view, photograph=replace(view.photograph, mask=found.get(view.name))) for view in capture.views
    )
    if not found and keeps == "black":
        raise InputError(
            f"scene.masks_keep=black, but no photograph of {capture.source} has a mask. Name their folder with "
            "scene.masks=FOLDER, or leave out masks_keep."
        )
    whole = [view.name for view in views if view.photograph.mask is None]
    if found and whole:
        log.warning("%d of %d photographs have no mask and are kept whole: %s", len(whole), len(views), listed(whole))
    return replace(capture, views=views)


def _masks_beside(folders: Sequence[Path], capture: Capture) -> dict[str, Path]:
    """Return the masks of an unnamed folder if it has one for each photograph; log what is done."""
    for folder in dict.fromkeys(each / name for each in folders for name in FOLDERS):
        if not folder.is_dir() or not pictures_below(folder):
            continue
        found, fault = _suitable(folder, capture)
        if found and not fault:
            log.info(
                "%s: %s has a mask for each photograph, which is used (scene.masks=none does without; "
                "scene.masks=%s names the folder)",
                *(capture.source, folder, folder.name),
            )
            return found
        if fault:
            log.warning(
                "%s: %s is not used, because %s; scene.masks=%s uses it", capture.source, folder, fault, folder.name
            )
    return {}


def _suitable(folder: Path, capture: Capture) -> tuple[dict[str, Path], str | None]:
    """Return the masks in a folder, and why they do not suit all photographs, if they do not.

    All sizes are compared, and a few masks are read.
    """
    try:
        found = _masks_in(folder, capture)
        if 0 < len(found) < len(capture.views):
            return found, f"it has masks for {len(found)} of {len(capture.views)} photographs"
        for view in capture.views if found else ():
            header = view.photograph.header or read_header(view.photograph.path)
            if not any(of_one_shape(image_size(found[view.name]), size) for size in (header.size, header.size[::-1])):
                return found, f"{found[view.name].name} has another shape than its photograph"
        paths = list(found.values())
        for number in evenly_spaced_subset(range(len(paths)), MOST_READ):
            if not read_mask(paths[number]).any():
                return found, f"{paths[number].name} keeps nothing"
    except InputError as error:
        return {}, str(error).split(". ")[0]
    return found, None


def _masks_in(folder: Path, capture: Capture) -> dict[str, Path]:
    photographs = {view.photograph.path for view in capture.views}
    return find_pictures([view.name for view in capture.views], folder, folder, capture.source, photographs=photographs)
