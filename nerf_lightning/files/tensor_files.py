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

from nerf_lightning.budgets import allowed, require_within
from nerf_lightning.errors import InputError
from nerf_lightning.files.regular import open_regular

CALLED = {
    "collections OrderedDict",
    "torch._utils _rebuild_tensor",
    "torch._utils _rebuild_tensor_v2",
    "torch._utils _rebuild_parameter",
}
"""What the files of this program, and state dicts, call."""
LEGACY_PICKLES = 5
"""Magic number, protocol, system, objects, names of the storages; then come the numbers (torch before 1.6)."""


def load_tensors(path: Path) -> Any:
    """Return the tensors and plain containers of a file that `torch.save` wrote, on the CPU.

    Raises:
        InputError: it is no regular file, or was made to fill the memory.
        pickle.UnpicklingError: it holds anything else than tensors and plain containers.
        Exception: whatever torch, zipfile and pickle raise for a file that is damaged, or of another kind.
    """
    with open_regular(path, allowed().tensor_bytes) as file:
        if zipfile.is_zipfile(file):
            pickles: list[Any] = [_objects_of_archive(file, path)]
        else:
            file.seek(0)
            pickles = [file] * LEGACY_PICKLES
        for stream in pickles:
            _require_plain(stream)
        file.seek(0)
        content = torch.load(file, map_location="cpu", weights_only=True)
    _require_own_memory(content, path)
    return content


def _objects_of_archive(file: BinaryIO, path: Path) -> io.BytesIO:
    """Return the part of the archive that is not numbers."""
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        announced, size = sum(entry.file_size for entry in entries), os.fstat(file.fileno()).st_size
        # torch.save compresses nothing. Entries that share their bytes are counted each.
        if announced > size or any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise InputError(
                f"{path} has {size:,} bytes and unpacks to {announced:,}: PyTorch saves without compression, so this "
                "file was made to fill the memory, or packed by another program. Use the file as it was saved."
            )
        # torch.load compares no checksums: a block of zeros in the middle of the weights would be believed.
        damaged = archive.testzip()
        if damaged is not None:
            raise zipfile.BadZipFile(f"wrong checksum of {damaged}")
        objects = [entry for entry in entries if entry.filename.endswith("data.pkl")]
        if len(objects) != 1:
            raise zipfile.BadZipFile("no data.pkl")
        require_within("object_bytes", objects[0].file_size, str(path), "bytes beside its numbers")
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


def _require_own_memory(content: Any, path: Path) -> None:
    """Refuse tensors whose numbers are fewer in the file than in their shape."""
    waiting, seen = [content], set[int]()
    while waiting:
        node = waiting.pop()
        if isinstance(node, Tensor):
            if node.numel() * node.element_size() > node.untyped_storage().nbytes():
                raise InputError(
                    f"{path} holds a tensor of the shape {tuple(node.shape)} that repeats few numbers: whatever is "
                    "done with it would fill the memory. This program saves none such; use another file."
                )
        elif isinstance(node, (dict, list, tuple, set)) and id(node) not in seen:
            seen.add(id(node))
            waiting += [*node.keys(), *node.values()] if isinstance(node, dict) else node
