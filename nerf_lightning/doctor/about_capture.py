"""What was examined, in one line: which folder, read as which format, how many photographs of what size."""

from nerf_lightning.nerf.types.scene import Scene

PARTS = ("train", "val", "test")


def about_capture(scene: Scene, place: str | None, form: str) -> str:
    """Return the line.

    Args:
        scene: as it was read.
        place: the folder or file that it was read from; None: none.
        form: how scene= names the format.
    """
    pixels = scene.pixels
    sizes = sorted(set(zip(pixels.width.tolist(), pixels.height.tolist(), strict=True)))
    largest = "{} x {}".format(*sizes[-1])
    read = f"of {largest}" if len(sizes) == 1 else f"of {len(sizes)} sizes up to {largest}"
    splits = ", ".join(f"{len(scene.splits[part])} {part}" for part in PARTS if scene.splits.get(part))
    return f"{place or scene.name}: scene={form}, {len(scene.view_names)} photographs {read} ({splits})"
