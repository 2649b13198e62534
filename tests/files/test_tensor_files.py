"""PyTorch's files as plain containers and tensors, whatever their pickles make of themselves."""

import pickle
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


def altered(path, change):
    """Write an archive anew with what `change` makes of its names and contents."""
    with zipfile.ZipFile(path) as archive:
        entries = [(name, archive.read(name)) for name in archive.namelist()]
    with zipfile.ZipFile(path, "w") as archive, pytest.MonkeyPatch.context() as patched:
        patched.setattr("warnings.warn", lambda *words, **options: None)  # of a name that is there twice
        for name, data in change(entries):
            archive.writestr(name, data)


def test_containers_and_tensors_are_made_anew(tmp_path):
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


def test_what_is_shared_is_made_once(tmp_path):
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


@pytest.mark.parametrize("name", ["DATA.PKL", "data.pkl", "data/0", "Data/0"])
def test_names_that_stand_in_an_archive_twice_are_refused(tmp_path, name):
    """PyTorch looks for names whatever their case, and takes another one of several than Python does."""
    path = write_checkpoint(tmp_path / "a.ckpt")
    altered(path, lambda entries: [*entries, (f"a/{name}", b"")])
    refused(read_checkpoint, path, parts=("a.ckpt cannot be read",))


def test_what_stands_before_an_archive_is_refused(tmp_path):
    """PyTorch would read it in the place of the archive."""
    path = write_checkpoint(tmp_path / "a.ckpt")
    path.write_bytes(pickle.dumps("read in its place", protocol=2) + path.read_bytes())
    with pytest.raises(zipfile.BadZipFile, match="something before the archive"):
        load_tensors(path)
    refused(read_checkpoint, path, parts=("a.ckpt cannot be read",))


def test_lists_in_lists_without_end_are_refused(tmp_path):
    path = write_checkpoint(tmp_path / "a.ckpt")
    for endless_pickle in (b"]" * 20_000 + b"a" * 19_999, b"]q\x00h\x00a"):
        replace_pickle(path, b"\x80\x02" + endless_pickle + b".")
        refused(read_checkpoint, path, parts=("a.ckpt",))
