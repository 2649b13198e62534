"""The binary files of a COLMAP model: little-endian records, each list after its length."""

import mmap
import os
import struct
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from nerf_lightning.data.readers.colmap.records import CURE, CURE_MODEL, MODELS, MOST_BYTES, ColmapCamera, ColmapImage
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.regular import open_regular
from nerf_lightning.messages.errors import InputError


class BinaryFiles:
    """Parse cameras.bin, images.bin and points3D.bin."""

    def cameras(self, path: Path) -> Iterator[tuple[int, ColmapCamera]]:
        """Return the cameras with their numbers."""
        data = _Bytes(path)
        count = data.count(24)
        require_within("views", count, str(path), "views")
        for _ in range(count):
            number, model, width, height = data.take("<IiQQ")
            if model not in MODELS:
                raise InputError(f"{path} holds a camera of the unknown model number {model}. {CURE_MODEL}")
            name, count = MODELS[model]
            yield number, ColmapCamera(name, width, height, data.take(f"<{count}d"))
        data.end()

    def images(self, path: Path) -> Iterator[ColmapImage]:
        """Return the photographs; the features in them are passed over."""
        data = _Bytes(path)
        count = data.count(73)
        require_within("views", count, str(path), "views")
        for _ in range(count):
            values = data.take("<I7dI")
            name = data.text()
            data.skip(24 * data.take("<Q")[0])
            yield ColmapImage(name, values[8], values[1:5], values[5:8])
        data.end()

    def points(self, path: Path) -> Float[ndarray, "points 3"]:
        """Return the sparse points; the photographs that they were seen in are passed over."""
        data = _Bytes(path)
        count = data.count(51)
        require_within("points", count, str(path), "points")
        found = array("d")
        for _ in range(count):
            values = data.take("<Q3d3Bd")
            data.skip(8 * data.take("<Q")[0])
            found.extend(values[1:4])
        data.end()
        return np.frombuffer(found, np.float64).reshape(-1, 3)


class _Bytes:
    """A file's bytes, taken in order; what is not there is named."""

    def __init__(self, path: Path):
        self.path, self.place = path, 0
        self.data: bytes | mmap.mmap
        try:
            with open_regular(path, MOST_BYTES, CURE) as file:
                # Mapped: what is passed over (features, tracks) is most of the file, and need not be in memory.
                empty = os.fstat(file.fileno()).st_size == 0
                self.data = b"" if empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}. Check its permissions.") from error

    def take(self, form: str) -> tuple:
        size = struct.calcsize(form)
        self._need(size)
        self.place += size
        return struct.unpack_from(form, self.data, self.place - size)

    def count(self, least_bytes: int) -> int:
        """Return the length of a list whose entries take at least so many bytes."""
        (count,) = self.take("<Q")
        self._need(count * least_bytes)
        return int(count)

    def skip(self, size: int) -> None:
        self._need(size)
        self.place += size

    def text(self) -> str:
        end = self.data.find(b"\0", self.place)
        if end < 0:
            self._need(len(self.data) + 1)
        name, self.place = self.data[self.place : end], end + 1
        try:
            return name.decode("utf-8")
        except UnicodeDecodeError as error:
            raise InputError(f"{self.path} holds a file name that is not UTF-8: {name!r}. {CURE}") from error

    def end(self) -> None:
        if self.place < len(self.data):
            raise InputError(
                f"{self.path} goes on for {len(self.data) - self.place} bytes after what it announces: it is damaged "
                f"or is no such file. {CURE}"
            )

    def _need(self, size: int) -> None:
        if self.place + size > len(self.data):
            raise InputError(
                f"{self.path} ends after {len(self.data)} bytes, in the middle of what it announces: it was cut short "
                f"or is no such file. {CURE}"
            )
