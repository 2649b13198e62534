"""Files that claim far more than they hold: read as what they are, or refused in one paragraph, at a bounded cost.

Pictures that do: tests/data/pixels/test_picture_bombs.py.
"""

import io
import json
import struct
import sys

import numpy as np
import pytest
from support.running import start_code

# One process reads all: with a gigabyte more than it has, and some seconds of the processor for each file.
READ = """
import json, os, resource, sys, warnings
from pathlib import Path
from nerf_lightning.data.readers.colmap_files import BinaryFiles, TextFiles
from nerf_lightning.data.readers.llff import _registered
from nerf_lightning.data.readers.ply_points import read_ply_points
from nerf_lightning.data.sfm.video_frames import count_frames
from nerf_lightning.files.json_files import read_json
from nerf_lightning.files.numpy_files import open_npz, read_npy
from nerf_lightning.files.tensor_files import load_tensors
from nerf_lightning.files.trust import reading
from nerf_lightning.files.xml_files import read_xml
from nerf_lightning.files.yaml_files import read_plain_yaml
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.curves import read_curves

def read_npz(path):
    with open_npz(path, "") as arrays:
        return [arrays[name] for name in arrays]

def caught(read):  # as the reader of captures does
    def read_caught(path):
        with reading(path):
            return read(path)
    return read_caught

READERS = {
    ".json": read_json, ".xml": lambda path: read_xml(path, ""), ".yaml": read_plain_yaml, ".ply": read_ply_points,
    ".npy": lambda path: read_npy(path, ""), ".npz": read_npz, ".pt": load_tensors,
    ".bin": caught(BinaryFiles().points), ".points": caught(TextFiles().points), ".gif": count_frames,
    ".txt": lambda path: _registered(path.parent, []), ".events": lambda path: read_curves(path.parent),
}
warnings.simplefilter("ignore")
size = 1024 * int(Path("/proc/self/status").read_text().split("VmSize:")[1].split()[0])
resource.setrlimit(resource.RLIMIT_AS, (size + 2**30, size + 2**30))
for path in map(Path, json.loads(sys.argv[1])):
    print(path.parent.name, flush=True)
    before = sum(os.times()[:4])
    resource.setrlimit(resource.RLIMIT_CPU, (int(sum(os.times()[:2])) + 8, resource.RLIM_INFINITY))
    try:
        READERS[path.suffix](path)
    except InputError as error:
        # What numpy cannot allocate, it has not begun to read.
        if "MemoryError" in str(error).replace("MemoryError: Unable to allocate", "") or "\\n" in str(error):
            print("BAD", error)
    if sum(os.times()[:4]) - before > 8:
        print("SLOW")
"""
SPARSE = 1 << 40


def gif(count, side):
    head = b"GIF89a" + struct.pack("<HHBBB", side, side, 0x80, 0, 0) + bytes(6)
    frame = b"\x21\xf9\x04\0\x01\0\0\0\x2c" + struct.pack("<4HB", 0, 0, side, side, 0) + b"\x02\x02\x44\x01\0"
    return head + count * frame + b"\x3b"


def npy(*shape):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue()


def ply(count, width, order="binary_little_endian"):
    more = "".join(f"property double p{number}\n" for number in range(width - 3))
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    return f"ply\nformat {order} 1.0\nelement vertex {count}\n{axes}{more}end_header\n".encode()


def zip_end(size):
    """Return the end of an archive whose list of entries is all that stands before it."""
    return struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 65535, 65535, size, 0, 0)


# By the name of the case: the file's ending, its first bytes, where it ends if it is sparse, and its last bytes.
CASES = {
    "keys of a json": (".json", b'{"":0' + b"".join(b',"number %d":1' % number for number in range(3_000_000)) + b"}"),
    "depth of a json": (".json", b'{"a":' * 500_000),
    "brackets of a json": (".json", b"[" + b"[]," * 900_000 + b"[]]"),
    "elements of an xml": (".xml", b"<a>" + b"<b/>" * 4_000_000 + b"</a>"),
    "attributes of an xml": (".xml", b"<a>" + b'<b c=""/>' * 400_000 + b"</a>"),
    "depth of an xml": (".xml", b"<a>" * 400_000 + b"</a>" * 400_000),
    "nodes of a yaml": (".yaml", b"[" + b"a," * 400_000 + b"a]"),
    "depth of a yaml": (".yaml", b"[" * 60_000),
    "lines of a text": (".txt", b"\n" * 10_000_000),
    "rows of a ply": (".ply", ply(700_000, 200), 1_200_000_000),
    "columns of a ply": (".ply", ply(10**6, 3, "ascii"), 3_200_000_000),
    "shape of an npy": (".npy", npy(10**12, 17) + bytes(1000)),
    "list of an npz": (".npz", b"PK", 1_900_000_000, zip_end(1_900_000_000)),
    "points of colmap": (".bin", struct.pack("<Q", 500_000), 800_000_000),
    "a line of colmap": (".points", b"1 ", 20_000_000_000),
    "frames of a video": (".gif", gif(800, 4000)),
    "size of a video": (".gif", gif(3, 15_000)),
    "values of events": (".events", b"\n" * 2_000_000),
    **{
        f"a sparse {name}": (f".{name}", start, SPARSE)
        for name, start in {"json": b"[", "xml": b"<a", "yaml": b"a", "txt": b"", "ply": b"ply", "npy": npy(10**9),
                            "npz": b"PK", "bin": b"", "points": b"1 ", "gif": b"GIF89a",
                            "pt": b"PK\3\4", "events": b"a"}.items()
    },
}  # fmt: skip


@pytest.mark.minutes
@pytest.mark.skipif(sys.platform != "linux", reason="the address space is read from /proc")
def test_files_that_claim_more_than_they_hold(tmp_path):
    files = []
    for name, (ending, start, *rest) in CASES.items():
        folder = tmp_path / name
        folder.mkdir()
        stem = {".txt": "view_imgs", ".events": "tfevents"}.get(ending, "a")
        with (folder / f"{stem}{ending}").open("wb") as file:
            file.write(start)
            if rest:
                file.truncate(rest[0])
                file.seek(rest[0])
                file.write(b"".join(rest[1:]))
        files.append(file.name)
    process = start_code(READ, json.dumps(files), stderr=-2)
    output, _ = process.communicate(timeout=300)
    assert output.splitlines() == list(CASES)
    assert process.returncode == 0
