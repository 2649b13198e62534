import json
import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
import torch
from PIL import Image
from support.captures import picture

from nerf_lightning.data.pixels import decoded_photographs as module
from nerf_lightning.data.pixels import mapped_store as pixel_file
from nerf_lightning.data.pixels.decoded_photographs import Photograph, read_photographs
from nerf_lightning.data.pixels.downscale import area_downscale, crop_to_multiple
from nerf_lightning.data.pixels.picture_files import PictureHeader, read_rgba
from nerf_lightning.files import atomic
from nerf_lightning.files.atomic import MACHINE
from nerf_lightning.messages.errors import InputError

SIZES = [(9, 7), (8, 8), (6, 10)]


def write(folder, sizes=SIZES):
    """Write pictures of several formats and sizes; the second has no alpha."""
    folder.mkdir(exist_ok=True)
    paths = [folder / name for name in ("a.png", "b.jpg", "c.webp")]
    for view, (path, size) in enumerate(zip(paths, sizes, strict=True)):
        image = Image.fromarray(picture(view, *size)).convert("RGB" if path.suffix == ".jpg" else "RGBA")
        image.save(path, **({"lossless": True, "exact": True} if path.suffix == ".webp" else {}))
    return [Photograph(path) for path in paths]


def write_mask(path, kept):
    Image.fromarray((np.asarray(kept) * 255).astype(np.uint8)).save(path)
    return path


def read(photographs, folder, downscale=1, verify=False):
    return read_photographs(photographs, downscale, folder, verify, "Reading")


@pytest.fixture
def capture(tmp_path):
    return write(tmp_path / "capture")


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "cache"


@pytest.fixture
def decoded(monkeypatch):
    """The names of the files that have been decoded."""
    names = []
    monkeypatch.setattr(module, "read_rgba", lambda path, upright: names.append(path.name) or read_rgba(path))
    return names


@pytest.mark.parametrize("downscale", [1, 2, 3])
def test_mapped_values_are_those_of_decoding(capture, cache, downscale):
    for _ in range(2):
        store = read(capture, cache, downscale)
        assert [list(size) for size in zip(store.width.tolist(), store.height.tolist(), strict=True)] == [
            [width // downscale, height // downscale] for width, height in SIZES
        ]
        for view, photograph in enumerate(capture):
            rgba = area_downscale(crop_to_multiple(read_rgba(photograph.path), downscale), downscale)
            assert np.array_equal(store.view(view).numpy(), rgba)
        assert store.mask is None
        assert store.view_mask(0) is None
        assert store.has_transparency


def test_transparency_is_known_without_looking_at_the_pixels(capture, cache):
    assert not read(capture[1:2], cache).has_transparency
    assert not read(capture[1:2], cache).has_transparency
    assert read(capture[:2], cache).has_transparency


def test_the_second_call_decodes_nothing_and_opens_no_picture(capture, cache, monkeypatch):
    first = read(capture, cache).rgba.clone()

    def fail(path):
        raise AssertionError(path)

    monkeypatch.setattr(module, "read_rgba", fail)
    monkeypatch.setattr(module, "read_header", fail)
    assert torch.equal(read(capture, cache).rgba, first)
    with pytest.raises(AssertionError):
        read(capture, cache, downscale=2)


def test_what_is_written_to_the_store_stays_in_the_process(capture, cache):
    store = read(capture, cache)
    before = store.rgba.clone()
    store.rgba.add_(1)
    assert not torch.equal(store.rgba, before)
    assert torch.equal(read(capture, cache).rgba, before)


def test_a_changed_file_is_decoded_again(capture, cache, decoded):
    read(capture, cache)
    del decoded[:]
    Image.fromarray(picture(9, *SIZES[0])).save(capture[0].path)
    assert np.array_equal(read(capture, cache).view(0).numpy(), picture(9, *SIZES[0]))
    assert sorted(decoded) == ["a.png", "b.jpg", "c.webp"]


def disguise(path, content):
    """Change a file so that neither its size nor its time shows it."""
    state = path.stat()
    path.write_bytes(content + b"\0" * (state.st_size - len(content)))
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))


def test_only_verify_finds_a_change_that_size_and_time_do_not_show(capture, cache, decoded):
    path = capture[1].path
    Image.fromarray(picture(7, 8, 8)[..., :3]).save(path, quality=95)
    before = read(capture, cache, verify=True).rgba.clone()
    count = len(decoded)
    read(capture, cache, verify=True)
    assert len(decoded) == count  # the same contents
    Image.new("RGB", (8, 8), "red").save(path.with_suffix(".new"), format="JPEG")
    disguise(path, path.with_suffix(".new").read_bytes())
    assert torch.equal(read(capture, cache).rgba, before)
    assert len(decoded) == count
    red = read(capture, cache, verify=True)
    assert len(decoded) == 2 * count
    assert red.view(1)[..., 0].min() > 200
    assert torch.equal(read(capture, cache).rgba, red.rgba)


def test_verify_does_not_trust_what_was_never_hashed(capture, cache, decoded):
    read(capture, cache)
    read(capture, cache, verify=True)
    read(capture, cache, verify=True)
    assert len(decoded) == 6


def another_size(path):
    header = json.loads(path.with_suffix(".json").read_text())
    header["sizes"][0] = [3, 3]
    path.with_suffix(".json").write_text(json.dumps(header))


def one_byte(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


DAMAGES = {
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-5]),
    "blank": lambda path: path.write_bytes(b"\0" * path.stat().st_size),
    "garbled": lambda path: path.with_suffix(".json").write_text("{ not json"),
    "forgotten": lambda path: path.with_suffix(".json").unlink(),
    "another size": another_size,
    "one byte": one_byte,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_store_is_made_again(capture, cache, decoded, damage):
    before = read(capture, cache).rgba.clone()
    (path,) = cache.glob("*.pixels")
    DAMAGES[damage](path)
    for _ in range(2):
        assert torch.equal(read(capture, cache).rgba, before)
        assert len(decoded) == 6


def test_a_file_larger_than_memory_is_mapped(tmp_path):
    """With holes, so that it takes no room; a mapping that might be written would be refused."""
    side = 1 << 14
    count = 2 + 2 * psutil.virtual_memory().total // (4 * side**2)
    with (tmp_path / "a.pixels").open("wb") as file:
        try:
            file.truncate(4 * count * side**2)
        except OSError as error:
            pytest.skip(f"no such file fits into this file system: {error}")
    header = pixel_file.Header(pixel_file.FORMAT, [[side, side]] * count, False, False, None, spots=0, checksum=0)
    store = pixel_file._mapped(tmp_path / "a.pixels", header)
    assert store.view(count - 1)[-1, -1].tolist() == [0, 0, 0, 0]


def test_a_failed_reader_leaves_nothing_and_a_killed_one_nothing_that_is_believed(capture, cache):
    sound = capture[0].path.read_bytes()
    capture[0].path.write_bytes(sound[: len(sound) * 2 // 3])  # its header is whole
    with pytest.raises(InputError, match=r"a.png cannot be read"):
        read(capture, cache)
    assert {path.suffix for path in cache.iterdir()} <= {".lock"}
    capture[0].path.write_bytes(sound)
    store = read(capture, cache)
    (path,) = cache.glob("*.pixels")
    path.rename(path.with_name(f".{path.stem}.999999999_{MACHINE}.nerf_lightning.part.pixels"))  # killed before that
    atomic.remove_leftovers.cache_clear()
    assert np.array_equal(read(capture, cache).rgba, store.rgba)
    assert not list(cache.glob("*.part*"))


def test_readers_that_read_at_once_share_one_file(capture, cache, decoded, monkeypatch):
    plain = module.read_rgba
    monkeypatch.setattr(module, "read_rgba", lambda *given: time.sleep(0.1) or plain(*given))
    with ThreadPoolExecutor(2) as readers:
        one, other = readers.map(lambda _: read(capture, cache), range(2))
    assert len(decoded) == 3
    assert torch.equal(one.rgba, other.rgba)
    assert sorted(path.suffix for path in cache.iterdir() if path.suffix != ".lock") == [".json", ".pixels"]


def test_masks_are_read_with_the_pictures(capture, cache, tmp_path):
    kept = np.random.default_rng(0).random((7, 9)) > 0.5
    masked = [Photograph(capture[0].path, write_mask(tmp_path / "m.png", kept)), *capture[1:]]
    for _ in range(2):
        store = read(masked, cache)
        assert np.array_equal(store.view_mask(0).numpy(), kept)
        assert store.view_mask(1).all()
        assert store.mask.numel() == len(store.rgba)
        assert np.array_equal(store.view(0).numpy(), read_rgba(capture[0].path))
    assert read(capture, cache).mask is None


def test_a_changed_mask_is_another_store(capture, cache, tmp_path):
    masked = [Photograph(capture[0].path, write_mask(tmp_path / "m.png", np.eye(7, 9)))]
    assert int(read(masked, cache).mask.sum()) == 7
    write_mask(tmp_path / "m.png", np.arange(63).reshape(7, 9) % 2)
    assert int(read(masked, cache).mask.sum()) == 31


@pytest.mark.parametrize(("kept", "downscale"), [(np.zeros((7, 9)), 1), (np.arange(63).reshape(7, 9) % 2, 2)])
def test_a_mask_that_leaves_nothing_is_refused(capture, cache, tmp_path, kept, downscale):
    mask = write_mask(tmp_path / "m.png", kept)
    with pytest.raises(InputError, match=r"m.png leaves no pixel of .*a.png.*keeps what is white.*remove this view"):
        read([Photograph(capture[0].path, mask)], cache, downscale)


def test_a_full_disk_is_found_before_anything_is_decoded(capture, cache, monkeypatch, decoded):
    free = SimpleNamespace(free=700)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: free)
    with pytest.raises(InputError, match=r"need 0\.00 GB in .*cache.*GB are free.*NERF_LIGHTNING_CACHE.*downscale"):
        read(capture, cache)
    assert not decoded
    free.free = 4 * sum(width * height for width, height in SIZES)
    read(capture, cache)


def test_a_disk_that_fills_up_meanwhile_is_one_paragraph(capture, cache, monkeypatch):
    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.Path, "touch", full)
    with pytest.raises(InputError, match=r"cannot be cached in .*cache: No space left on device. Make room"):
        read(capture, cache)


def test_a_folder_that_cannot_be_written_is_named(capture, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match=r"cannot be cached in .*file.cache: .*scene.cache_dir"):
        read(capture, tmp_path / "file" / "cache")


def test_absent_files_and_empty_lists_are_refused(capture, cache):
    with pytest.raises(InputError, match=r"gone.jpg cannot be read: No such file"):
        read([*capture, Photograph(capture[0].path.with_name("gone.jpg"))], cache)
    with pytest.raises(InputError, match=r"Reading: there is no photograph to read"):
        read([], cache)
    with pytest.raises(InputError, match=r"scene.downscale=8 leaves nothing of a photograph of 9 x 7"):
        read(capture, cache, downscale=8)


def test_the_default_folder_follows_the_environment(capture, tmp_path, monkeypatch):
    monkeypatch.setenv("NERF_LIGHTNING_CACHE", str(tmp_path / "own"))
    read(capture, None)
    assert len(list((tmp_path / "own" / "photographs").glob("*.pixels"))) == 1


def test_a_file_that_changes_while_it_is_read_is_noticed(capture, cache, monkeypatch):
    monkeypatch.setattr(module, "read_header", lambda path: PictureHeader((4, 4), 1))
    with pytest.raises(InputError, match=r"(a.png|b.jpg|c.webp) changed while it was read"):
        read(capture, cache)
