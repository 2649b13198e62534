"""PyTorch's files as plain containers and tensors, whatever their pickles make of themselves."""

import pickle
import struct
import zipfile
from collections import OrderedDict

import pytest
import torch
from support.planted import replace_pickle, write_checkpoint
from support.running import refused
from torch import nn

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.files.tensor_files import load_tensors


class Shadowed(dict):
    """Is read as an OrderedDict whose methods are hidden by attributes."""

    def __reduce__(self):
        hidden = dict.fromkeys(["items", "keys", "values", "get", "update", "pop"])
        return OrderedDict, (), hidden, None, iter(dict.items(self))


def altered(path, change, compression=zipfile.ZIP_STORED):
    """Write an archive anew with what `change` makes of its names and contents."""
    with zipfile.ZipFile(path) as archive:
        entries = [(name, archive.read(name)) for name in archive.namelist()]
    with zipfile.ZipFile(path, "w") as archive, pytest.MonkeyPatch.context() as patched:
        patched.setattr("warnings.warn", lambda *words, **options: None)  # of a name that is there twice
        for name, data in change(entries):
            archive.writestr(zipfile.ZipInfo(name), data, compression)


def test_containers_and_tensors_are_made_anew_and_what_is_shared_once(tmp_path):
    shared = (0.9, 0.99)
    state = Shadowed({"a": nn.Parameter(torch.ones(2)), "b": [Shadowed({"c": shared}), shared]})
    torch.save(state, tmp_path / "a.pt")
    content = load_tensors(tmp_path / "a.pt")
    assert type(content) is dict
    assert list(content) == ["a", "b"]
    assert type(content["a"]) is torch.Tensor
    assert not content["a"].requires_grad
    assert content["b"] == [{"c": shared}, shared]
    assert type(content["b"][0]) is dict
    """Fifty lists, each of which holds the one before twice, would else be 2^50."""
    whole = []
    for _ in range(50):
        whole = [whole, whole]
    torch.save(whole, tmp_path / "a.pt")
    content = load_tensors(tmp_path / "a.pt")
    assert content[0] is content[1]


@pytest.mark.parametrize("place", ["top", "record", "weights"])
def test_a_checkpoint_of_shadowed_dictionaries_is_checked_like_any(tmp_path, place):
    repeated = {"model.x": torch.zeros(1).expand(10**9)}

    def shadow(content):
        content["state_dict"] |= repeated
        if place == "weights":
            content["state_dict"] = Shadowed(content["state_dict"])
        elif place == "record":
            content["nerf_lightning"] = Shadowed(content["nerf_lightning"] | {"more": repeated})
        else:
            whole = Shadowed(content)
            content.clear()
            content["nerf_lightning"] = whole

    path = write_checkpoint(tmp_path / "a.ckpt", shadow)
    refused(read_checkpoint, path, parts=("a.ckpt", "repeats few numbers"))


def with_prefix(path):
    """PyTorch would read what stands before the archive."""
    return pickle.dumps("read in its place", protocol=2) + path.read_bytes()


def with_two_archives(path):
    """Offsets that are relative to the second archive for one reader, and for another those of the first."""
    altered(path, lambda entries: entries)
    sound = path.read_bytes()
    altered(path, lambda entries: [(name, bytes(len(data)) if len(data) == 1024 else data) for name, data in entries])
    return path.read_bytes()[:-22] + sound


def with_an_end_behind_the_end(path):
    """Python sees no archive, so that the instructions of a pickle are looked for, and are those of a name."""
    altered(
        path,
        lambda entries: [(f"\n...../{name[2:]}", data) for name, data in [("a/first", b""), *entries]],
        zipfile.ZIP_DEFLATED,
    )
    return path.read_bytes() + b"PK\x05\x06"


def with_another_directory(path):
    """A locator of zip64 that points to other records than those before it."""
    content = bytearray(path.read_bytes())
    struct.pack_into("<Q", content, len(content) - 42 + 8, 0)
    return bytes(content)


def with_bytes_used_twice(path):
    """An entry of the directory that has the bytes of another one."""
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        start, entries = archive.start_dir, archive.infolist()
    second = content.index(entries[1].filename.encode(), start) - 46
    struct.pack_into("<L", content, second + 42, entries[0].header_offset)
    return bytes(content)


OTHERS = {
    "a prefix": with_prefix,
    "two archives": with_two_archives,
    "an end behind the end": with_an_end_behind_the_end,
    "a comment": lambda path: path.read_bytes()[:-2] + b"\x01\x00!",
    "a gap": lambda path: path.read_bytes()[:-98] + bytes(8) + path.read_bytes()[-98:],
    "another directory": with_another_directory,
    "bytes used twice": with_bytes_used_twice,
    "numbers that differ": lambda path: path.read_bytes()[:-6] + bytes(6),
}


@pytest.mark.parametrize("change", OTHERS.values(), ids=OTHERS)
def test_only_exactly_one_archive_is_read(tmp_path, change):
    """Two readers of archives may find different contents in these, so there is no right one."""
    path = write_checkpoint(tmp_path / "a.ckpt")
    path.write_bytes(change(path))
    refused(read_checkpoint, path, parts=("a.ckpt is damaged, or was made by somebody else: it ",))


@pytest.mark.parametrize("name", ["data.pkl", "data/0"])
def test_names_that_stand_in_an_archive_twice_are_refused(tmp_path, name):
    path = write_checkpoint(tmp_path / "a.ckpt")
    altered(path, lambda entries: [*entries, (f"a/{name}", b"")])
    refused(read_checkpoint, path, parts=("a.ckpt", "two of one name"))


def test_storages_are_what_the_file_holds(tmp_path):
    """A storage that claims more numbers than its entry has would be filled from nowhere."""
    path = write_checkpoint(tmp_path / "a.ckpt", lambda content: content.update(extra=torch.zeros(1000)))
    with zipfile.ZipFile(path) as archive:
        content = archive.read("a/data.pkl")
    replace_pickle(path, content.replace(b"M\xe8\x03t", b"J\x00\x00\x00\x7ft"))
    refused(read_checkpoint, path, parts=("a.ckpt", "1000 numbers in the storage"))


@pytest.mark.parametrize(
    "instruction", [b"\x96" + bytes([255] * 5) + bytes(3), b"c__builtin__\nbytearray\n.", b"\x93."]
)
def test_instructions_that_weights_do_not_need_are_refused(tmp_path, instruction):
    path = write_checkpoint(tmp_path / "a.ckpt")
    replace_pickle(path, b"\x80\x02" + instruction)
    refused(read_checkpoint, path, parts=("a.ckpt",))


def test_lists_in_lists_without_end_are_refused_and_the_format_before_1_6_with_how_to_convert_it(tmp_path):
    """A file of it can order any memory: a storage that its list of keys omits is never held against the file."""
    torch.save({"a": torch.ones(2)}, tmp_path / "a.pt", _use_new_zipfile_serialization=False)
    refused(load_tensors, tmp_path / "a.pt", parts=("before version 1.6", "torch.save(torch.load('OLD'"))
    path = write_checkpoint(tmp_path / "a.ckpt")
    for endless_pickle in (b"]" * 20_000 + b"a" * 19_999, b"]q\x00h\x00a"):
        replace_pickle(path, b"\x80\x02" + endless_pickle + b".")
        refused(read_checkpoint, path, parts=("a.ckpt",))
