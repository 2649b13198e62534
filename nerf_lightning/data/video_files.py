"""Which files are handed to ffmpeg: containers of video, told by their first bytes.

ffmpeg also reads playlists and scripts, whatever their ending, and opens the files and addresses that they name.
"""

from pathlib import Path

from nerf_lightning.errors import InputError
from nerf_lightning.files.regular import explained, open_regular

STARTS = {
    "Matroska, WebM": b"\x1a\x45\xdf\xa3",
    "MPEG program stream": b"\x00\x00\x01\xba",
    "MPEG video": b"\x00\x00\x01\xb3",
    "Flash": b"FLV\x01",
    "Ogg": b"OggS",
    "Windows Media": b"\x30\x26\xb2\x75\x8e\x66\xcf\x11",
    "GIF 87": b"GIF87a",
    "GIF 89": b"GIF89a",
}
BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot")
"""What an mp4 or QuickTime file begins with, after four bytes of length."""
PACKETS = ((0, 188), (4, 192))
"""First byte and length of the packets of an MPEG transport stream."""
SYNC = 0x47


def require_video(path: Path) -> None:
    """Refuse what is no container of video.

    Raises:
        InputError: with what is read.
    """
    # However large: a few frames of it are in memory at a time.
    with explained(path), open_regular(path, None) as file:
        start = file.read(600)
    known = start.startswith(tuple(STARTS.values())) or start[4:8] in BOXES
    riff = start[:4] == b"RIFF" and start[8:12] == b"AVI "
    stream = any(start[first::length][:3] == bytes([SYNC]) * 3 for first, length in PACKETS)
    if not (known or riff or stream):
        raise InputError(
            f"{path} is not a video that is read here: mp4, mov, mkv, webm, avi, ts, mpg, flv, ogg, wmv and gif are. "
            "Playlists and scripts of ffmpeg are not followed. Convert it to an mp4 (H.264)."
        )
