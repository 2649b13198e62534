"""Scale, up and north from the GPS positions that cameras and drones write into photographs (EXIF)."""

import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from PIL import ExifTags

from nerf_lightning.data.pixels.picture_files import DECODER_ERRORS, opened_picture
from nerf_lightning.messages.errors import InputError

EQUATOR, FLATTENING = 6_378_137.0, 1 / 298.257223563
"""Equatorial radius of the earth in meters, and its flattening at the poles (WGS 84)."""
FEWEST = 4
OFF = 10.0
"""Error of a receiver in meters."""
LEAST_SPREAD = 4.0
"""Minimum ratio of the positions' spread across their longest line to their error."""

log = logging.getLogger(__name__)


def gps_of(path: Path) -> tuple[float, float, float] | None:
    """Return latitude and longitude in degrees, and altitude in meters; None if a photograph has none."""
    try:
        with opened_picture(path) as image:
            said: Mapping[int, Any] = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        place = [_degrees(said, key, negative) for key, negative in ((2, "S"), (4, "W"))]
        height = float(said.get(6, 0.0)) * (-1 if said.get(5) in (1, b"\x01") else 1)
    except (InputError, *DECODER_ERRORS):
        return None
    latitude, longitude = place
    sound = abs(latitude) <= 90 and abs(longitude) <= 180 and abs(height) < 1e5 and (latitude or longitude)
    return (latitude, longitude, height) if sound else None


def _degrees(said: Mapping[int, Any], key: int, negative: str) -> float:
    degrees, minutes, seconds = (float(part) for part in said[key])
    return (degrees + minutes / 60 + seconds / 3600) * (-1 if said.get(key - 1) == negative else 1)


def in_metres(places: Sequence[tuple[float, float, float]]) -> Float[ndarray, "photographs 3"]:
    """Return positions as meters east, north and up from their center, in the tangent plane there.

    >>> in_metres([(0.0, 0.0, 5.0), (0.0, 0.001, 5.0)]).round(1).tolist()
    [[-55.7, 0.0, 0.0], [55.7, 0.0, 0.0]]
    """
    latitude, longitude, height = np.array(places, dtype=np.float64).T
    longitude = longitude[0] + (longitude - longitude[0] + 180) % 360 - 180  # across the date line, too
    middle = math.radians(latitude.mean())
    squashed = 1 - FLATTENING * (2 - FLATTENING) * math.sin(middle) ** 2
    along_parallel = EQUATOR / math.sqrt(squashed) * math.cos(middle)
    along_meridian = EQUATOR * (1 - FLATTENING) ** 2 / squashed**1.5
    metres = np.stack([np.radians(longitude) * along_parallel, np.radians(latitude) * along_meridian, height], axis=1)
    return metres - metres.mean(axis=0)


def align_to_gps(colmap: Any, model: Any, folder: Path) -> bool:
    """Align a COLMAP model to meters, x east and z up, if the GPS positions of its photographs are good enough.

    The positions must fit the model, and spread in two directions by several times their error: a table that was
    photographed from all sides is smaller than a receiver's error.

    Args:
        colmap: the module pycolmap.
        model: its reconstruction; modified if this returns true.
        folder: of the photographs.
    """
    names = [model.image(number).name for number in model.reg_image_ids()]
    places = {name: place for name in names if (place := gps_of(folder / name)) is not None}
    if len(places) < FEWEST:
        return False
    wanted = in_metres(list(places.values()))
    options = colmap.RANSACOptions()
    options.max_error = OFF
    found = colmap.align_reconstruction_to_locations(model, list(places), wanted, FEWEST, options)
    if found is None:
        return False
    centers = {
        image.name: image.projection_center() for image in (model.image(number) for number in model.reg_image_ids())
    }
    off = np.linalg.norm(np.stack([found * centers[name] for name in places]) - wanted, axis=1)
    across = np.linalg.svd(wanted, compute_uv=False)[1] / math.sqrt(len(wanted))
    if across < LEAST_SPREAD * np.median(off):
        log.info("cameras: GPS positions are off by %.1f m, too much for photographs so close together", np.median(off))
        return False
    model.transform(found)
    log.info(
        "cameras: aligned with the GPS positions of %d photographs, to %.1f m: units are meters, z is up "
        "(scene.metres_per_unit=1)",
        *(len(places), np.median(off)),
    )
    return True
