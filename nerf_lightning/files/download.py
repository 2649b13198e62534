"""Fetch one public file: verified, atomic, one process at a time."""

import hashlib
import http.client
import logging
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

from filelock import FileLock

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.messages.errors import InputError

TIMEOUT = 10.0
LOCAL = ("localhost", "127.0.0.1", "::1")

log = logging.getLogger(__name__)


def fetch(url: str, target: Path, num_bytes: int, sha256: str | None) -> None:
    """Download the file at `url` to `target`; do nothing if it already exists.

    The target appears only if its size and checksum are correct.

    Args:
        url: an HTTPS address. Plain HTTP is accepted only with a checksum, or from this machine.
        target: destination of the file; its folder is made.
        num_bytes: its exact size, which must fit into memory.
        sha256: its checksum in hexadecimal; None checks the size only.
    """
    try:
        make_folder(target.parent)
        with FileLock(f"{target}.lock"):
            if not target.exists():
                log.info("Downloading %s (%.1f MB) to %s.", url, num_bytes / 1e6, target)
                content = _received(url, num_bytes, sha256)
                with whole_file(target) as part:
                    part.write_bytes(content)
    except (http.client.HTTPException, OSError, ValueError) as error:
        if isinstance(error, HTTPError):
            error.close()  # it holds the response
        raise InputError(
            f"Could not download {url}: {error or type(error).__name__}. Run again to try once more, or get "
            f"the file ({num_bytes} bytes) from that address by hand and put it at {target.resolve()}."
        ) from error


def _received(url: str, num_bytes: int, sha256: str | None) -> bytes:
    parts = urlsplit(url)
    # No other server's response is accepted.
    if parts.scheme != "https" and not (parts.scheme == "http" and (sha256 or parts.hostname in LOCAL)):
        raise ValueError(f"{url} is not an https address, which is needed without a checksum")
    with urlopen(Request(url, headers={"User-Agent": "nerf-lightning"}), timeout=TIMEOUT) as response:
        content: bytes = response.read(num_bytes + 1)
    if len(content) != num_bytes:
        raise ValueError(f"the file should have {num_bytes} bytes, but {len(content)} came")
    found = hashlib.sha256(content).hexdigest()
    if sha256 not in (None, found):
        raise ValueError(f"its checksum is {found}, not {sha256}")
    return content
