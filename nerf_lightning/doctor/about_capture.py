"""What was examined, in one line: which folder, read as which format, how many photographs of what size."""

from collections.abc import Mapping, Sequence

from nerf_lightning.nerf.types.scene import Scene


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
    splits = shares(scene.splits, len(scene.view_names))
    return f"{place or scene.name}: scene={form}, {len(scene.view_names)} photographs {read} ({splits})"


def shares(splits: Mapping[str, Sequence[int]], num_views: int) -> str:
    """Return how the views are shared out; the numbers add up to all of them.

    >>> shares({"train": (1, 2), "val": (0,), "test": (0,)}, 3)
    '2 train, 1 held out for val and test'
    >>> shares({"train": (0, 1), "val": (2, 3), "test": (3, 4)}, 6)
    '2 train, 1 val, 1 test, 1 val and test, 1 unused'
    """
    train, val, test = (set(splits.get(part, ())) for part in ("train", "val", "test"))
    both = "val and test" if val != test else "held out for val and test"
    of_each = {"train": train, "val": val - test, "test": test - val, both: val & test}
    counts = {name: len(views) for name, views in of_each.items()}
    counts["unused"] = num_views - len(train | val | test)
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count)
