"""Recognize full panoramas among photographs, and choose one kind from a mix.

Cameras of panoramas are found on the panoramas themselves with COLMAP's EQUIRECTANGULAR camera: it has no lens to
estimate, and compares rays, so that features count in all directions.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from nerf_lightning.data.sfm.photograph_folder import FEWEST, FoundPhotograph
from nerf_lightning.data.sfm.settings import Panoramas
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed

EQUIRECTANGULAR = "EQUIRECTANGULAR"
"""Their camera model in COLMAP and in transforms.json."""
STRETCH = 0.01
"""Relative tolerance of a panorama's width against twice its height: some cameras crop a few rows."""
STATIONARY = 1 / 720
"""Share of a panorama's width (half a degree): details that move less between two panoramas move with the camera."""

log = logging.getLogger(__name__)


def of_one_kind(photographs: Sequence[FoundPhotograph], panoramas: Panoramas, source: str) -> list[FoundPhotograph]:
    """Return the photographs whose cameras can be found together: only panoramas, or only others.

    With `auto`, panoramas are those marked as such and those of the same size; if none is marked, all are, if every one
    is exactly twice as wide as high. Of a mix, the panoramas are left out if at least three others remain, else the
    others. A warning names what is left out.

    Args:
        photographs: with `is_panorama` from their headers.
        panoramas: true treats pictures twice as wide as high, within 1 %, as panoramas; false treats all as plain
            photographs.
        source: as given by the user, for messages: `images=DIR` or `video=FILE`.

    Returns:
        The chosen photographs, in the same order, all with the same `is_panorama`.

    Raises:
        InputError: fewer than three of either kind.
    """
    if panoramas is False:
        return [replace(photograph, is_panorama=False) for photograph in photographs]
    said = [photograph for photograph in photographs if photograph.is_panorama]
    around = _all_around(photographs, panoramas, source)
    if panoramas is True and len(around) < FEWEST:
        raise InputError(
            f"panoramas=true, but {len(around)} of {len(photographs)} pictures of {source} are twice as wide as high "
            f"(within 1 %), as panoramas of all directions are, and at least {FEWEST} are needed. Export the panoramas "
            "as equirectangular pictures from the camera's program, or leave panoramas=auto."
        )
    # Partial panoramas are marked as panoramas, too, and COLMAP has no camera model for them.
    unlike = {*around, *said}
    plain = [photograph for photograph in photographs if photograph not in unlike]
    takes_panoramas = panoramas is True or len(plain) < FEWEST
    taken = around if takes_panoramas else plain
    if len(taken) < FEWEST:
        raise InputError(
            f"{source} holds {len(around)} full panoramas, {len(unlike) - len(around)} partial ones and {len(plain)} "
            f"other photographs, and at least {FEWEST} of the first or the last are needed. Take more of these, or "
            "read them all as plain photographs with panoramas=false."
        )
    if left_out := sorted({*photographs} - {*taken}, key=lambda photograph: photograph.path):
        why = "are not full panoramas, and the others are" if takes_panoramas else "are panoramas"
        others = not takes_panoramas and len(around) >= FEWEST
        log.warning(
            "%s: %d of %d pictures are left out, since they %s: %s.%s",
            *(source, len(left_out), len(photographs), why, listed((p.path.name for p in left_out), 5)),
            " panoramas=true (scene.panoramas=true in training) takes these, and leaves the others out." * others,
        )
    return [replace(photograph, is_panorama=takes_panoramas) for photograph in taken]


def lens_of(colmap: Any, photographs: Sequence[FoundPhotograph], otherwise: str) -> str:
    """Return COLMAP's lens model for photographs of one kind.

    Args:
        colmap: the module pycolmap.
        photographs: as returned by `of_one_kind`.
        otherwise: the model for other photographs.

    Raises:
        InputError: this pycolmap does not support panoramas.
    """
    if not any(photograph.is_panorama for photograph in photographs):
        return otherwise
    if not hasattr(colmap.CameraModelId, EQUIRECTANGULAR):
        raise InputError(
            f"Finding the cameras of panoramas needs pycolmap 4.1 or later, and {colmap.__version__} is installed. "
            "Update it with: pip install -U 'pycolmap>=4.1,<5'"
        )
    return EQUIRECTANGULAR


def verification_of(colmap: Any, photographs: Sequence[FoundPhotograph]) -> Any:
    """Return pycolmap's options for verifying the pairs of photographs of one kind.

    Every panorama shows the person who carries the camera, or its tripod, at the same place in the picture. These
    details match best and suggest that the camera did not move, so stationary details do not count.
    """
    options = colmap.TwoViewGeometryOptions()
    if any(photograph.is_panorama for photograph in photographs):
        options.filter_stationary_matches = True
        options.stationary_matches_max_error = STATIONARY * min(photograph.width for photograph in photographs)
    return options


def _all_around(photographs: Sequence[FoundPhotograph], panoramas: Panoramas, source: str) -> list[FoundPhotograph]:
    """Return the full panoramas, by the rules of `of_one_kind`."""
    whole = [p for p in photographs if abs(p.width / (2 * p.height) - 1.0) <= STRETCH]
    sizes = {(p.width, p.height) for p in photographs if p.is_panorama}
    if panoramas is True:
        return whole
    if not sizes and all(p.width == 2 * p.height for p in photographs):
        log.info(
            "%s: all %d pictures are exactly twice as wide as high, so they are read as panoramas of all directions; "
            "panoramas=false (scene.panoramas=false in training) reads them as plain photographs",
            *(source, len(photographs)),
        )
        return whole
    return [p for p in whole if (p.width, p.height) in sizes]
