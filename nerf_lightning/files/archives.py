"""Zip archives, which PyTorch and numpy write: files that are exactly one, so that all readers see the same in them."""

import io
import os
import struct

from nerf_lightning.files.trust import Mismatch

END, END64, LOCATOR = struct.Struct("<4s4H2LH"), struct.Struct("<4sQ2H2L4Q"), struct.Struct("<4sLQL")
"""What an archive ends with; the records of zip64 (the latter two), where there are any, come first."""


def start_of_directory(file: io.BufferedReader, most_bytes: int) -> int:
    """Return where the directory of a file's one archive begins.

    Args:
        file: it has one end record, at its end, whose offsets count from its beginning.
        most_bytes: the largest size of the directory.

    Raises:
        Mismatch: it has not, or is no archive.
    """
    size, records = os.fstat(file.fileno()).st_size, END64.size + LOCATOR.size
    file.seek(max(0, size - records - END.size))
    tail = file.read().rjust(records + END.size, b"\0")
    mark, *_, length, offset, _ = END.unpack_from(tail, records)
    end = size - END.size
    if tail.startswith(b"PK\x06\x07", END64.size):
        end -= records
        mark64, *_, length64, offset64 = END64.unpack_from(tail)
        # The fields of 32 bits may leave the numbers to those of 64.
        same = length in (length64, 0xFFFFFFFF) and offset in (offset64, 0xFFFFFFFF)
        if mark64 != b"PK\x06\x06" or LOCATOR.unpack_from(tail, END64.size)[2] != end or not same:
            raise Mismatch("it", "is not one archive: its end records contradict each other")
        length, offset = length64, offset64
    if mark != b"PK\x05\x06" or offset + length != end or length > most_bytes:
        raise Mismatch("it", "is not one zip archive of an allowed size, or was cut short")
    return int(offset)
