"""PyTorch files (`torch.save`) as plain containers and tensors: one reader, so what is checked is what is loaded.

Such a file is a zip archive of a pickle (`NAME/data.pkl`) and of the bytes of each storage (`NAME/data/KEY`). A machine
that knows only the instructions and calls needed for weights runs the pickle, and tensors are views of the entries'
bytes: no code in the file is executed, and its tensors take no more memory than the file.

Which classes a checkpoint's config may name: `checkpoints/trusted_classes.py`.
"""

import io
import pickle
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from nerf_lightning.files.archives import start_of_directory
from nerf_lightning.files.budgets import limits
from nerf_lightning.files.regular import open_regular
from nerf_lightning.files.trust import Mismatch
from nerf_lightning.messages.errors import InputError

LEGACY = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19."
LOCAL = struct.Struct("<4s22x2H")
INSTRUCTIONS = (
    "PROTO STOP MARK NONE NEWTRUE NEWFALSE BININT BININT1 BININT2 LONG1 BINFLOAT BINUNICODE EMPTY_LIST APPEND APPENDS "
    "EMPTY_DICT SETITEM SETITEMS EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 BINPUT LONG_BINPUT BINGET LONG_BINGET GLOBAL "
    "REDUCE BINPERSID"
)
"""Instructions of protocol 2, which torch.save writes; BUILD, which sets attributes of state dicts, is skipped."""
_Machine: Any = pickle._Unpickler  # in Python, so that instructions can be left out


def load_tensors(path: Path) -> Any:
    """Return the tensors and plain containers of a file that `torch.save` wrote, on the CPU.

    Raises:
        InputError: it is not a regular file, is larger than allowed, or is in PyTorch's format before version 1.6.
        Mismatch: it is another kind of file, or contains anything but tensors and plain containers.
        Exception: whatever zipfile, pickle and torch raise for a damaged file.
    """
    with open_regular(path, "tensor") as file:
        if file.read(len(LEGACY)) == LEGACY:
            raise InputError(
                f"{path} is in PyTorch's format from before version 1.6, which is not read. If you trust it, convert "
                "it with today's PyTorch: torch.save(torch.load('OLD', weights_only=True), 'NEW')"
            )
        return _Unpickler(file).load()


def _entries(file: io.BufferedReader) -> dict[str, tuple[int, int, int]]:
    """Return the offset, the number of bytes and the checksum of each entry by name.

    The file must be exactly one archive, whose entries are uncompressed and do not overlap.

    Raises:
        Mismatch: it is not; the message says why.
    """
    directory = start_of_directory(file, limits().tensor_objects)
    with zipfile.ZipFile(file) as archive:
        listed = sorted(archive.infolist(), key=lambda entry: entry.header_offset)
    entries, previous = dict[str, tuple[int, int, int]](), 0
    for entry in listed:
        file.seek(entry.header_offset)
        mark, *lengths = LOCAL.unpack(file.read(LOCAL.size))
        start = entry.header_offset + LOCAL.size + sum(lengths)
        if mark != b"PK\x03\x04" or not previous <= entry.header_offset <= start + entry.file_size <= directory:
            raise Mismatch("it", "holds entries that overlap")
        if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1 or entry.filename in entries:
            raise Mismatch("it", "holds a compressed entry, or two of one name; torch.save writes neither")
        entries[entry.filename], previous = (start, entry.file_size, entry.CRC), start + entry.file_size
    return entries


def _view(storage: Tensor, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: object) -> Tensor:
    """Return a tensor of a storage, like `torch._utils._rebuild_tensor_v2`, without gradients or hooks."""
    tensor = storage.as_strided(size, stride, offset)
    if tensor.numel() > len(storage):
        raise Mismatch("it", f"holds a tensor of the shape {tuple(size)} that repeats few numbers, to fill memory")
    return tensor


GLOBALS: dict[str, Any] = {
    "collections.OrderedDict": dict,
    "torch._utils._rebuild_tensor_v2": _view,
    "torch._utils._rebuild_parameter": lambda data, *_: data,
    **{"torch.FloatStorage": torch.float32, "torch.DoubleStorage": torch.float64, "torch.HalfStorage": torch.float16},
    **{"torch.BFloat16Storage": torch.bfloat16, "torch.LongStorage": torch.int64, "torch.IntStorage": torch.int32},
    **{"torch.ShortStorage": torch.int16, "torch.CharStorage": torch.int8, "torch.ByteStorage": torch.uint8},
    "torch.BoolStorage": torch.bool,
}
"""Globals used by this program's files and state dicts; a storage is read as numbers of its dtype."""


class _Unpickler(_Machine):
    """Follow the pickle of an archive, with fewer instructions and calls."""

    dispatch: ClassVar = {
        code[0]: _Machine.dispatch[code[0]] for code in (vars(pickle)[name] for name in INSTRUCTIONS.split())
    }
    dispatch[pickle.BUILD[0]] = lambda self: self.stack.pop()

    def __init__(self, file: io.BufferedReader):
        self.file, self.entries, self.storages = file, _entries(file), dict[str, Tensor]()
        names = [name for name in self.entries if name.endswith("/data.pkl")]
        if len(names) != 1 or self.entries[names[0]][1] > limits().tensor_objects:
            raise Mismatch("it", "has no data.pkl, several, or one that is too large")
        self.root = names[0].removesuffix("data.pkl")
        if f"{self.root}byteorder" in self.entries and self._content("byteorder").tobytes() != b"little":
            raise Mismatch("it", "is not little-endian")
        super().__init__(io.BytesIO(self._content("data.pkl").tobytes()))

    def _content(self, name: str) -> Any:
        """Return a copy of an entry's bytes: a mapped file can change after it was checked."""
        start, size, checksum = self.entries[f"{self.root}{name}"]
        content: Any = np.empty(size, np.uint8)
        self.file.seek(start)
        if self.file.readinto(content) != size or zlib.crc32(content) != checksum:
            raise Mismatch("it", f"has the wrong checksum in {name}")
        return content

    def find_class(self, module: str, name: str) -> Any:
        """Return the object that a global of the pickle stands for."""
        path = f"{module}.{name}"
        if path not in GLOBALS:
            raise Mismatch("it", f"holds more than plain values ({path[:100]!a}), and nothing from a file is executed")
        return GLOBALS[path]

    def persistent_load(self, pid: Any) -> Tensor:
        """Return a storage as a flat tensor; each is read once."""
        _, dtype, key, _, count = pid
        if key not in self.storages:
            self.storages[key] = torch.from_numpy(self._content(f"data/{key}"))
        flat = self.storages[key].view(dtype)
        if len(flat) != count:
            raise Mismatch("it", f"has {len(flat)} numbers in the storage {key}, not {count}")
        return flat
