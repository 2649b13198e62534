"""Zip archives, which PyTorch and NumPy write: files that are exactly one, so that all readers see the same content."""

import io
import os
import struct

from nerf_lightning.files.trust import Mismatch

END, END64, LOCATOR = struct.Struct("<4s4H2LH"), struct.Struct("<4sQ2H2L4Q"), struct.Struct("<4sLQL")
"""The records at the end of an archive; those of zip64 (the latter two), if any, come first."""


def start_of_directory(file: io.BufferedReader, most_bytes: int) -> int:
    """Return the offset of the directory of a file's only archive.

    Args:
        file: must have one end record, at its end, whose offsets count from its beginning.
        most_bytes: maximum size of the directory.

    Raises:
        Mismatch: it does not, or is not an archive.
    """
    size, records = os.fstat(file.fileno()).st_size, END64.size + LOCATOR.size
    file.seek(max(0, size - records - END.size))
    tail = file.read().rjust(records + END.size, b"\0")
    mark, *_, length, offset, _ = END.unpack_from(tail, records)
    end = size - END.size
    if tail.startswith(b"PK\x06\x07", END64.size):
        end -= records
        mark64, *_, length64, offset64 = END64.unpack_from(tail)
        # The 32-bit fields may defer to the 64-bit ones.
        same = length in (length64, 0xFFFFFFFF) and offset in (offset64, 0xFFFFFFFF)
        if mark64 != b"PK\x06\x06" or LOCATOR.unpack_from(tail, END64.size)[2] != end or not same:
            raise Mismatch("it", "is not one archive: its end records contradict each other")
        length, offset = length64, offset64
    if mark != b"PK\x05\x06" or offset + length != end or length > most_bytes:
        raise Mismatch("it", "is not one zip archive of an allowed size, or was cut short")
    return int(offset)
