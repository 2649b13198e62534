"""Files of PyTorch's that a stranger may have made: read as data, and never larger in memory than on the disk.

`weights_only=True` runs nothing, but it still takes orders for memory: records that unpack to a thousand times their
size, `bytearray(10**12)`, tensors of a trillion numbers that are one number repeated. The files that this program reads
need none of that, so that all of it is refused before, or as soon as, it is seen.
"""

import io
import os
import pickle
import pickletools
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from nerf_lightning.files.budgets import limits
from nerf_lightning.files.regular import open_regular
from nerf_lightning.messages.errors import InputError

CALLED = {
    "collections OrderedDict",
    "torch._utils _rebuild_tensor",
    "torch._utils _rebuild_tensor_v2",
    "torch._utils _rebuild_parameter",
}
"""What the files of this program, and state dicts, call."""
ARCHIVE = b"PK\x03\x04"
OBJECT_BYTES = 1 << 24
"""Most bytes of that part of a file that is not numbers."""
LEGACY_PICKLES = 5
"""Magic number, protocol, system, objects, names of the storages; then come the numbers (torch before 1.6)."""


def load_tensors(path: Path) -> Any:
    """Return the tensors and plain containers of a file that `torch.save` wrote, on the CPU.

    Raises:
        InputError: it is no regular file, or was made to fill the memory.
        pickle.UnpicklingError: it holds anything else than tensors and plain containers.
        Exception: whatever torch, zipfile and pickle raise for a file that is damaged, or of another kind.
    """
    with open_regular(path, limits().tensor_bytes) as file:
        if zipfile.is_zipfile(file):
            pickles: list[Any] = [_objects_of_archive(file, path)]
        else:
            file.seek(0)
            pickles = [file] * LEGACY_PICKLES
        for stream in pickles:
            _require_plain(stream)
        file.seek(0)
        return _made_anew(torch.load(file, map_location="cpu", weights_only=True), path, {})


def _objects_of_archive(file: BinaryIO, path: Path) -> io.BytesIO:
    """Return the part of the archive that is not numbers."""
    file.seek(0)
    # Else PyTorch takes what stands before the archive for a file of its earlier versions.
    if file.read(len(ARCHIVE)) != ARCHIVE:
        raise zipfile.BadZipFile("something before the archive")
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        # PyTorch looks for names whatever their case, and of several takes another one than Python does.
        if len({entry.filename.lower() for entry in entries}) < len(entries):
            raise zipfile.BadZipFile("several entries of one name")
        announced, size = sum(entry.file_size for entry in entries), os.fstat(file.fileno()).st_size
        # torch.save compresses nothing. Entries that share their bytes are counted each.
        if announced > size or any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise InputError(
                f"{path} has {size:,} bytes and unpacks to {announced:,}: PyTorch saves without compression, so this "
                "file was made to fill memory, or packed by another program. Use the file as it was saved."
            )
        # torch.load compares no checksums: a block of zeros in the middle of the weights would be believed.
        damaged = archive.testzip()
        if damaged is not None:
            raise zipfile.BadZipFile(f"wrong checksum of {damaged}")
        objects = [entry for entry in entries if entry.filename.lower().endswith("data.pkl")]
        if len(objects) != 1:
            raise zipfile.BadZipFile("no data.pkl")
        if objects[0].file_size > OBJECT_BYTES:
            raise zipfile.BadZipFile(f"{objects[0].file_size:,} bytes beside its numbers")
        return io.BytesIO(archive.read(objects[0]))


def _require_plain(stream: Any) -> None:
    """Read the instructions of a pickle without following them."""
    for code, argument, _ in pickletools.genops(stream):
        if code.name == "GLOBAL" and argument not in CALLED and not _names_a_type(str(argument)):
            raise pickle.UnpicklingError(f"calls {argument}")


def _names_a_type(argument: str) -> bool:
    module, _, name = argument.partition(" ")
    known = getattr(torch, name, None) if module == "torch" and name.isidentifier() else None
    return isinstance(known, torch.dtype) or (known is not None and name.endswith("Storage"))


def _made_anew(node: Any, path: Path, made: dict[int, Any]) -> Any:
    """Return tensors and containers of Python's own types; a pickle can hide an OrderedDict's methods by attributes.

    `made` has what was met before, by its `id`, and what it became.
    """
    if isinstance(node, Tensor):
        if node.numel() * node.element_size() > node.untyped_storage().nbytes():
            raise InputError(
                f"{path} holds a tensor of the shape {tuple(node.shape)} that repeats few numbers: using it would fill "
                "memory. This program saves no such tensors; use another file."
            )
        return node.detach()
    if id(node) in made or not isinstance(node, (dict, list, tuple, set)):
        return made.get(id(node), node)
    if isinstance(node, dict):
        table: dict[Any, Any] = {}
        made[id(node)] = table  # before what it holds, which may be itself
        table.update((key, _made_anew(value, path, made)) for key, value in dict.items(node))
    else:
        made[id(node)] = type(node)(_made_anew(each, path, made) for each in node)
    return made[id(node)]
