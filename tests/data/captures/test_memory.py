import sys

import pytest
from PIL import Image
from support.captures import pose, write_transforms
from support.running import start_code

SIDE = 384
VIEWS = 224
# How far the constant part may differ between two readings: the pictures that threads hold at the same moment.
NOISE = 2 * 2**20

MEASURE = """
import sys
from nerf_lightning.data.readers.blender import BlenderReader


def peak():
    with open("/proc/self/status") as status:
        return 1024 * int(next(line for line in status if line.startswith("VmHWM")).split()[1])


kept = []
for factor, few, many in ((1, 16, 4), (2, 4, 1)):
    # What a picture takes while it is decoded is in the peak of the first reading already.
    kept.append(BlenderReader(sys.argv[1], downscale=factor, skip={"train": few}).read())
    before = peak()
    kept.append(BlenderReader(sys.argv[1], downscale=factor, skip={"train": many}).read())
    print(peak() - before, len(kept[-1].pixels.rgba))
"""


@pytest.mark.minutes
@pytest.mark.skipif(sys.platform != "linux", reason="the peak of the resident memory is read from /proc")
def test_reading_takes_the_store_and_no_more(tmp_path):
    Image.radial_gradient("L").resize((SIDE, SIDE)).convert("RGBA").save(tmp_path / "r_0.png")
    for view in range(1, VIEWS):
        (tmp_path / f"r_{view}.png").hardlink_to(tmp_path / "r_0.png")
    frames = [{"file_path": f"r_{view}", "transform_matrix": pose(view)} for view in range(VIEWS)]
    write_transforms(tmp_path, "train", frames)
    process = start_code(MEASURE, tmp_path)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    growth = [[int(number) for number in line.split()] for line in output.splitlines()]
    assert len(growth) == 2
    for num_bytes, pixels in growth:
        print(f"{num_bytes / pixels:.3f} bytes per pixel")
        assert num_bytes <= 4.2 * pixels + NOISE
        # Much less would mean that the peak had been reached before; of a mapped store only what is looked at counts.
        assert num_bytes >= 2.5 * pixels
