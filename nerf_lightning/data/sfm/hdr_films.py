"""Recognize HDR films, as phones record them, and tone-map the kept frames to SDR by ffmpeg."""

import logging
import re
import subprocess
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

HDR = re.compile(r"\b(arib-std-b67|smpte2084)\b")
"""ffmpeg's names of the transfer functions HLG (also of phones' Dolby Vision, profile 8.4) and PQ (HDR10)."""
FILTERS = {"zscale", "tonemap"}
TO_SDR = (
    "format=gbrp,setparams=color_primaries=bt2020:color_trc={transfer}:colorspace=gbr:range=pc,format=gbrpf32le,"
    "zscale=transfer=linear:npl=203,zscale=primaries=bt709,tonemap=mobius:param=0.7:desat=0,zscale=transfer=bt709"
)
"""White is at 203 nits, as in BT.2408; up to 0.7 of it colors are kept, above they are compressed."""

log = logging.getLogger(__name__)


def hdr_transfer(video: Path, input_params: Sequence[str]) -> str | None:
    """Return ffmpeg's name of an HDR film's transfer function if it can be tone-mapped; else None.

    Args:
        video: the film.
        input_params: ffmpeg's arguments before its name.

    Raises:
        OSError, RuntimeError, ValueError, IndexError: ffmpeg cannot read it.
    """
    import imageio_ffmpeg

    with closing(imageio_ffmpeg.read_frames(str(video), input_params=list(input_params))) as stream:
        found = HDR.search(next(stream)["pix_fmt"])
    if found is None:
        return None
    if not set(_run_ffmpeg("-filters").decode().split()) >= FILTERS:
        log.warning(
            "%s is filmed in HDR (%s), and this ffmpeg has no zscale to tone-map it: colors will look flat. Film "
            "without HDR, or convert the film to SDR first.",
            *(video, found[0]),
        )
        return None
    log.info("%s is filmed in HDR (%s): its frames are tone-mapped to SDR", video, found[0])
    return found[0]


def tone_mapped(frame: UInt8[np.ndarray, "height width 3"], transfer: str) -> UInt8[np.ndarray, "height width 3"]:
    """Return a frame of an HDR film with BT.2020 primaries as SDR (BT.709).

    Raises:
        RuntimeError: ffmpeg fails.
    """
    height, width = frame.shape[:2]
    pixels = ("-f", "rawvideo", "-pix_fmt", "rgb24")
    source = (*pixels, "-s", f"{width}x{height}", "-i", "-")
    shown = _run_ffmpeg(*source, "-vf", TO_SDR.format(transfer=transfer), *pixels, "-", content=frame.tobytes())
    return np.frombuffer(shown, np.uint8).reshape(frame.shape)


def _run_ffmpeg(*arguments: str, content: bytes = b"") -> bytes:
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-loglevel", "error", *arguments]
    result = subprocess.run(command, input=content, capture_output=True, check=False)
    if result.returncode:
        raise RuntimeError(result.stderr.decode(errors="replace"))
    return result.stdout
