"""Only regular files are opened: nothing waits for a FIFO, and what is refused is named with its cure."""

import os
import socket

import pytest
from support.waiting import fifo, within

from nerf_lightning.files.regular import contents, open_regular, open_to_append, read_bytes, read_text
from nerf_lightning.messages.errors import InputError

pytestmark = pytest.mark.skipif(os.name != "posix", reason="FIFOs, sockets and devices are posix's")


def folder(path):
    path.mkdir()


def of_socket(path):
    # Its address may have a hundred letters at most.
    os.chdir(path.parent)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(path.name)


def device(path):
    path.symlink_to("/dev/zero")


def waiting_reader(path):
    fifo(path)
    os.open(path, os.O_RDONLY | os.O_NONBLOCK)


KINDS = {"a named pipe (FIFO)": fifo, "a folder": folder, "a socket": of_socket, "a device": device}
OPENED = {
    "open_regular": lambda path: open_regular(path, 10, "Mend it."),
    "read_bytes": lambda path: read_bytes(path, 10, "Mend it."),
    "read_text": lambda path: read_text(path, "text", "Mend it."),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("open_", OPENED.values(), ids=OPENED)
def test_other_kinds_are_refused(tmp_path, monkeypatch, kind, open_):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "it"
    KINDS[kind](path)
    with within(5), pytest.raises(InputError) as caught:
        open_(path)
    assert str(caught.value) == f"{path} is {kind}, and only regular files are opened here. Mend it."


@pytest.mark.parametrize("kind", [fifo, waiting_reader, folder, device])
def test_nothing_is_appended_to_another_kind(tmp_path, kind):
    kind(tmp_path / "it")
    with within(5), pytest.raises(InputError, match=r"it is a (named pipe|folder|symbolic link)"):
        open_to_append(tmp_path / "it")


def test_a_link_is_followed_where_that_is_allowed_and_not_written_through(tmp_path):
    (tmp_path / "there").write_bytes(b"content")
    (tmp_path / "it").symlink_to(tmp_path / "there")
    assert read_bytes(tmp_path / "it", 10) == b"content"
    with pytest.raises(InputError, match=r"it is a symbolic link"):
        open_regular(tmp_path / "it", 10, follow_links=False)
    with pytest.raises(InputError, match=r"it is a symbolic link, and only regular files"):
        open_to_append(tmp_path / "it")
    assert (tmp_path / "there").read_text() == "content"


def test_a_larger_file_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "it"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    for open_ in OPENED.values():
        with pytest.raises(InputError, match=r"it has 1,099,511,627,776 bytes, more than the limit of 1"):
            open_(path)
    with pytest.raises(InputError, match=r"limit of 16,777,216\. .* add budgets\.text_bytes=1099511627776"):
        read_text(path, "text")
    open_regular(path, None).close()


def test_regular_files_are_read_and_appended_to_and_what_is_no_text_is_named(tmp_path):
    path = tmp_path / "it"
    for _ in range(2):
        with open_to_append(path) as file:
            file.write("ü\r\n".encode())
    assert read_bytes(path, 8) == b"\xc3\xbc\r\n" * 2
    assert read_text(path, "text") == "ü\n" * 2
    with open_regular(path, 8) as file:
        assert file.read() == path.read_bytes()
    (tmp_path / "it").write_bytes(b"ab\xff")
    with pytest.raises(InputError, match=r"it is not a text file \(byte 2 is not UTF-8\)"):
        read_text(tmp_path / "it", "text")


@pytest.mark.parametrize("name", ["absent", "nul\0", "x" * 300, "folder/it"])
def test_what_cannot_be_opened_is_named(tmp_path, name):
    with pytest.raises(InputError, match=r"does not exist; the folder holds nothing.* Put the file there, or give"):
        read_bytes(tmp_path / name, 10, "Mend it.")


def test_a_folder_is_described_with_what_is_no_file_in_it(tmp_path):
    fifo(tmp_path / "transforms.json")
    device(tmp_path / "b")
    (tmp_path / "c").symlink_to("nowhere")
    (tmp_path / "d").symlink_to("d")
    (tmp_path / "images").mkdir()
    (tmp_path / "poses.npy").touch()
    assert contents(tmp_path) == (
        "b (a device), c (a symbolic link to nowhere, which leads nowhere), "
        "d (a symbolic link to d, which leads nowhere), images, poses.npy, transforms.json (a named pipe (FIFO))"
    )
    with pytest.raises(InputError, match=r"c is a symbolic link to nowhere, which leads nowhere. Put"):
        read_bytes(tmp_path / "c", 10)
