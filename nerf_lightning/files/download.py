"""Fetch one public file: resumable, checked, atomic, one process at a time."""

import hashlib
import http.client
import logging
import os
import shutil
import urllib.error
import urllib.request
from pathlib import Path
from typing import NoReturn
from urllib.parse import urlsplit

from filelock import FileLock
from rich.progress import BarColumn, DownloadColumn, TimeRemainingColumn, TransferSpeedColumn

from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.files.regular import open_regular, open_to_append
from nerf_lightning.messages.console import progress_bar
from nerf_lightning.messages.errors import InputError

TIMEOUT = 10.0
CHUNK = 1 << 16
LOCAL = ("localhost", "127.0.0.1", "::1")

log = logging.getLogger(__name__)


def fetch(url: str, target: Path, num_bytes: int, sha256: str | None) -> None:
    """Bring the file at `url` to `target`; do nothing if it is there already.

    What has arrived is kept in `<target>.part`, and the next call goes on from there. The target appears only
    when its size and checksum are right.

    Args:
        url: an https address. Plain http is taken only with a checksum, or from this machine.
        target: where the file shall lie; its folder is made.
        num_bytes: its exact size.
        sha256: its checksum in hexadecimal; None checks the size only.
    """
    try:
        parts = urlsplit(url)
        # Nobody else's answer is believed.
        if parts.scheme != "https" and not (parts.scheme == "http" and (sha256 or parts.hostname in LOCAL)):
            raise _Failure(f"{url} is not an https address, and without a checksum nothing else is trusted")
        make_folder(target.parent)
        with FileLock(f"{target}.lock"):
            if not target.exists():
                part = Path(f"{target}.part")
                needed, free = num_bytes - _size(part), shutil.disk_usage(part.parent).free
                if free < needed:
                    raise _Failure(f"{part.parent} has {free} bytes free, but {needed} more are needed")
                _receive(url, part, num_bytes)
                _check_content(part, num_bytes, sha256)
                os.replace(part, target)
                log.info("Downloaded %s to %s.", url, target)
    except (_Failure, http.client.HTTPException, OSError, ValueError) as error:
        raise InputError(
            f"Could not download {url}: {error or type(error).__name__}. Run again to try once more, or get "
            f"the file ({num_bytes} bytes) from that address by hand and put it at {target.resolve()}."
        ) from error


class _Failure(Exception):
    """A reason, without the cure that `fetch` adds."""


def _size(part: Path) -> int:
    """Return how much has arrived."""
    return part.stat().st_size if part.exists() else 0


def _receive(url: str, part: Path, num_bytes: int) -> None:
    """Append to the part file what it still lacks."""
    have = _size(part)
    if have > num_bytes:
        part.unlink()
        have = 0
    if have == num_bytes:
        return
    headers = {"User-Agent": "nerf-lightning"} | ({"Range": f"bytes={have}-"} if have else {})
    request = urllib.request.Request(url, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=TIMEOUT) as response:
            # A server without ranges answers 200 with the whole file: start over.
            first = response.headers.get("Content-Range", "").removeprefix("bytes ").partition("-")[0]
            resumes = response.status == 206 and first == str(have)
            _copy(response, part, have if resumes else 0, num_bytes)
    except urllib.error.HTTPError as error:
        with error:
            _refused(error, part)
    except urllib.error.URLError as error:
        raise _Failure(f"no connection ({error.reason})") from error
    if _size(part) < num_bytes:
        raise _Failure(f"the connection broke off after {_size(part)} of {num_bytes} bytes, which are kept in {part}")


def _refused(error: urllib.error.HTTPError, part: Path) -> NoReturn:
    """Report the server's refusal; a part that the server cannot continue is useless."""
    if error.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
        part.unlink()
    raise _Failure(f"the server answered {error.code} {error.reason}") from error


def _copy(response: http.client.HTTPResponse, part: Path, start: int, num_bytes: int) -> None:
    """Write the answer's body from byte `start` on, no more than one chunk beyond the file's size."""
    columns = ("{task.description}", BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    if not start:
        part.unlink(missing_ok=True)
    with open_to_append(part) as file, progress_bar(*columns) as bar:
        task = bar.add_task(part.stem, total=num_bytes, completed=start)
        while start <= num_bytes and (chunk := response.read(CHUNK)):
            file.write(chunk)
            start += len(chunk)
            bar.update(task, completed=start)


def _check_content(part: Path, num_bytes: int, sha256: str | None) -> None:
    """Refuse, and remove, a file that is not the one expected."""
    size = _size(part)
    if size != num_bytes:
        part.unlink()
        raise _Failure(f"the server's file has not {num_bytes} bytes: {size} had arrived when it was stopped")
    if sha256 is None:
        return
    with open_regular(part, num_bytes) as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != sha256:
        part.unlink()
        raise _Failure(f"its checksum is {found}, not {sha256}; what arrived was removed")
