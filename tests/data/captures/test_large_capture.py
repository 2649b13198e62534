"""A capture that is much larger than memory: 10,000 photographs of 1080p, trained on within 2 GB."""

import json
import math
import sys
from pathlib import Path

import pytest
from PIL import Image
from support.running import start_code

VIEWS, WIDTH, HEIGHT = 10_000, 1920, 1080
GIGABYTE = 1e9

# Photographs are decoded once into a file that is mapped from then on: here the file is there and full of holes, since
# decoding 10,000 pictures would take half an hour and 83 GB. The rest is the program's own way.
TRAIN = """
import statistics, sys, threading, time

from nerf_lightning.data.pixels import decoding
from nerf_lightning.data.pixels.mapped_store import FORMAT, Header
from nerf_lightning.data.ray_batches import RayBatches


def write_nothing(files, downscale, contents, label, target):
    sizes = [[1920, 1080] for _ in files]
    with target.open("wb") as file:
        file.truncate(4 * sum(width * height for width, height in sizes))
    return Header(FORMAT, sizes, False, False, contents, spots=0)


def anonymous():
    with open("/proc/self/status") as status:
        return 1024 * int(next(line for line in status if line.startswith("RssAnon")).split()[1])


def watch():
    while not done.wait(0.02):
        most[0] = max(most[0], anonymous())


seconds = []
at = RayBatches.at


def timed(*arguments):
    start = time.perf_counter()
    batch = at(*arguments)
    seconds.append(time.perf_counter() - start)
    return batch


decoding._write = write_nothing
RayBatches.at = timed
most, done = [0], threading.Event()
watcher = threading.Thread(target=watch)
watcher.start()
try:
    from nerf_lightning.cli.main import main

    sys.argv = ["nerf", "train", *sys.argv[1:]]
    main()
finally:
    done.set()
    watcher.join()
    warm = seconds[-50:]
    print("RESULT", most[0], len(seconds), statistics.median(warm), max(warm))
"""


def write_capture(root: Path) -> None:
    """One photograph under 10,000 names, from places around the content."""
    (root / "images").mkdir(parents=True)
    Image.new("RGB", (WIDTH, HEIGHT), (90, 120, 60)).save(root / "images" / "0.png")
    frames = []
    for view in range(VIEWS):
        if view:
            (root / "images" / f"{view}.png").hardlink_to(root / "images" / "0.png")
        angle, tilt = 2.4 * view, 0.2 + 0.8 * view / VIEWS
        c, s, up, level = math.cos(angle), math.sin(angle), math.sin(tilt), math.cos(tilt)
        back = (c * level, s * level, up)
        rows = [[-s, -c * up, back[0], 4 * back[0]], [c, -s * up, back[1], 4 * back[1]], [0.0, level, up, 4 * up]]
        frames.append({"file_path": f"images/{view}.png", "transform_matrix": [*rows, [0.0, 0.0, 0.0, 1.0]]})
    lens = {"fl_x": 1600.0, "fl_y": 1600.0, "cx": 960.0, "cy": 540.0, "w": WIDTH, "h": HEIGHT}
    (root / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))


def require_sparse_files(folder: Path) -> None:
    probe = folder / "probe"
    with probe.open("wb") as file:
        try:
            file.truncate(4 * VIEWS * WIDTH * HEIGHT)
        except OSError as error:
            pytest.skip(f"no file of 83 GB fits into this file system: {error}")
    taken = 512 * probe.stat().st_blocks
    probe.unlink()
    if taken > 1e6:
        pytest.skip("this file system has no sparse files")


@pytest.mark.exhaustive
@pytest.mark.skipif(sys.platform != "linux", reason="anonymous memory is read from /proc")
def test_ten_thousand_photographs_train_in_two_gigabytes(tmp_path):
    require_sparse_files(tmp_path)
    write_capture(tmp_path / "capture")
    arguments = (
        "scene=transforms", f"scene.root={tmp_path / 'capture'}", f"scene.cache_dir={tmp_path / 'cache'}",
        "model=nerf_tiny", "logger=none", "data.batch_rays=1024", "data.val_rays=256", "data.crop_steps=0",
        "trainer.max_steps=100", "trainer.tile_points=8192", "trainer.num_threads=1",
        "~callbacks.validation_pictures",
        "final.evaluate=false", "final.video=false", f"paths.output_dir={tmp_path / 'run'}",
    )  # fmt: skip
    process = start_code(TRAIN, *arguments, env={"OMP_NUM_THREADS": "1"})
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, output + errors
    assert "mapped file" in output + errors
    print(output)
    anonymous, batches, median, longest = map(float, output.split("RESULT")[1].split()[:4])
    print(f"anonymous memory {anonymous / GIGABYTE:.2f} GB at the most; {batches:.0f} batches")
    print(f"the last 50 batches took {1e3 * median:.1f} ms, the longest {1e3 * longest:.1f} ms")
    assert anonymous < 2 * GIGABYTE
    stored = next((tmp_path / "cache").glob("*.pixels")).stat()
    assert stored.st_size == 4 * VIEWS * WIDTH * HEIGHT
    assert 512 * stored.st_blocks < 0.01 * stored.st_size
