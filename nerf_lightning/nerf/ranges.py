"""The ranges of settings, held where they are taken: a model's may come out of a file, and are not looked at later."""

from collections.abc import Mapping


def require_ranges(settings: Mapping[str, object], ranges: Mapping[str, tuple[int | float, int | float]]) -> None:
    """Refuse settings that are out of their ranges; None, which stands for what a class chooses, is in all.

    Args:
        settings: by name; others than those with a range may be among them.
        ranges: least and greatest, by name.

    Raises:
        ValueError: with the first that is out of its range.
    """
    for name, (least, greatest) in ranges.items():
        value = settings[name]
        if value is not None and not least <= value <= greatest:  # type: ignore[operator]
            raise ValueError(f"{name}={value}: give {least} to {greatest}")
