"""`nerf train scene=photos` ends with a film, whatever photographs it is given."""

import pytest
from PIL import Image, ImageOps
from support.captures import real_capture
from support.running import output_of, start

QUICK = {"kermit": "", "sacre_coeur": "", "cup_colmap": "images", "fern": "images_8"}
SLOW = {"lund_street": "", "banana_photos": "", "sceaux_photos": "images", "fox": "images"}
LONGER_SIDE, MOST = 640, 30
FEW_STEPS = (
    "trainer.max_steps=4", "scene.longest=64", "scene.downscale=auto", "data.batch_rays=256", "path.num_frames=2",
    "path.width=32", "evaluation.max_views=1", "final.report=false",
)  # fmt: skip


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "folder"),
    [
        *(pytest.param(*each, marks=pytest.mark.minutes) for each in QUICK.items()),
        *(pytest.param(*each, marks=pytest.mark.exhaustive) for each in SLOW.items()),
    ],
)
def test_photographs_without_cameras_become_a_film(tmp_path, name, folder):
    pytest.importorskip("pycolmap")
    root, output = tmp_path / "photographs", tmp_path / "run"
    root.mkdir()
    pictures = sorted(path for path in (real_capture(name) / folder).iterdir() if path.suffix.lower() != ".txt")
    for path in pictures[:: -(-len(pictures) // MOST)]:
        with Image.open(path) as picture:
            exif = picture.getexif()
            exif.pop(0x0112, None)  # the turn is done
            small = ImageOps.exif_transpose(picture).convert("RGB")
            small.thumbnail((LONGER_SIDE, LONGER_SIDE))
            small.save(root / f"{path.stem}.jpg", quality=95, exif=exif)
    where = f"scene.root={root}", f"scene.cache_dir={tmp_path / 'cache'}", f"paths.output_dir={output}"
    output_of(start("train", "scene=photos", *where, *FEW_STEPS))
    assert (output / "video.mp4").stat().st_size > 0
