"""Which file a capture means by the name of a picture: one rule for all of its names, whoever wrote them and where.

Files name pictures by absolute paths of another machine, from their parent's folder, with backslashes, or with another
ending than what is there. All names of a file are changed in the same way: so many folders are dropped at their
beginning, and the rest lies in one folder of the capture.
"""

import logging
import os
import re
import unicodedata
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from nerf_lightning.data.pixels.images import ENDINGS
from nerf_lightning.files.links import is_there
from nerf_lightning.files.walk import walk
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed

PICTURE_FOLDERS = ("images", "image", "rgb", "input", "", "images_2", "images_4", "images_8")
"""Where photographs lie below a capture's folder, the likeliest first."""
KNOWN_ENDINGS = (*ENDINGS, ".heic", ".heif", ".hif", ".dng", ".bmp", ".exr")
SPLIT_FOLDERS = ("train", "val", "test", "eval")
"""Names that tell pictures apart which are called alike: they are never dropped."""
BESIDE_PHOTOGRAPHS = re.compile(r"(masks?|depths?|normals?|segmentations?|semantics?|confidence)(_.*)?")
"""Folders of pictures that are no photographs."""
DRIVE = re.compile(r"^[a-zA-Z]:")

log = logging.getLogger(__name__)


class Rule(NamedTuple):
    """How names become files."""

    folder: Path
    dropped: int
    """So many folders of the name are not there."""


def find_pictures(
    names: Sequence[str], folder: Path, root: Path, source: Path, outside: bool = False, say: bool = True
) -> dict[str, Path]:
    """Return the file of each name; names that none fits are absent.

    A name's own file in `folder` counts first. Else the pictures below `root` are searched, and the rule is taken that
    finds most. Letters' case and endings may differ where one file alone then fits.

    Args:
        names: as the capture has them.
        folder: what they are relative to.
        root: the capture's folder.
        source: the file that has the names, for messages.
        outside: whether names may lead out of `root` and `folder`.
        say: whether to name a file that is found by another name.

    Raises:
        InputError: two folders fit alike, and neither is called as a folder of photographs is.
    """
    inside = [Path(os.path.abspath(each)) for each in (root, folder)]
    exact = {name: path for name in names if (path := named_picture(folder, name, None if outside else inside))}
    if len(exact) == len(names):
        return exact
    rules = _rules([name for name in names if name not in exact], root, folder)
    if len(exact) and not any(len(found) + len(exact) >= len(names) for found in rules.values()):
        # Names are right as they are, and some files are missing; but their case or ending may differ.
        rules = {rule: found for rule, found in rules.items() if rule == Rule(folder, 0)}
    if not rules:
        return exact
    most = max(map(len, rules.values()))
    best = min((rule for rule in rules if len(rules[rule]) == most), key=lambda rule: _rank(rule, folder, root))
    same = [
        rule for rule in rules if len(rules[rule]) == most and _rank(rule, folder, root) == _rank(best, folder, root)
    ]
    if len(same) > 1:
        raise InputError(
            f"{source} names pictures such as {names[0]}, which fit files of {listed(rule.folder for rule in same)} "
            "alike. Say which are meant with scene.images=FOLDER, or move the others away."
        )
    found = rules[best]
    name, path = next(iter(found.items()))
    if say:
        log.info(
            "%s: %d of %d pictures are found by another name, such as %s for %s",
            *(source, len(found), len(names), path.relative_to(root) if path.is_relative_to(root) else path, name),
        )
    return {name: path for name in names if (path := exact.get(name) or found.get(name))}


def pictures_below(root: Path) -> list[Path]:
    """Return the picture files in a folder and its subfolders, through links too, in order of their names."""
    found = [base / name for base, _, names in walk(root, through_links=True) for name in names]
    return sorted(path for path in found if path.suffix.lower() in ENDINGS and not path.name.startswith("."))


def named_picture(folder: Path, name: str, inside: list[Path] | None = None) -> Path | None:
    """Return the file that a name is of as it stands, where it lies inside of one of some folders.

    instant-ngp and Blender leave endings out.
    """
    named = folder / name.replace("\\", "/")
    if inside is not None and not any(Path(os.path.abspath(named)).is_relative_to(each) for each in inside):
        return None
    candidates = [named] if named.suffix.lower() in KNOWN_ENDINGS else []
    candidates += [named.with_name(named.name + ending) for ending in ENDINGS] if named.name else []
    return next(filter(is_there, candidates), None)


def _parts(name: str) -> tuple[str, ...]:
    plain = DRIVE.sub("", name.replace("\\", "/")).lstrip("/")
    return tuple(part for part in PurePosixPath(plain).parts if part not in (".", ".."))


def _plain(parts: tuple[str, ...]) -> tuple[str, ...]:
    """Return parts of a path as they are compared: without ending and case, and with one form of each letter."""
    *folders, last = (unicodedata.normalize("NFC", part).casefold() for part in parts)
    while (stem := Path(last)).suffix in KNOWN_ENDINGS and stem.stem:  # masks are called 0001.jpg.png
        last = stem.stem
    return (*folders, last)


def _rules(names: Sequence[str], root: Path, folder: Path) -> dict[Rule, dict[str, Path]]:
    """Return the files that each rule finds, where it finds another for every name."""
    below: dict[str, list[tuple[Path, tuple[str, ...], set[str]]]] = defaultdict(list)
    for place in dict.fromkeys((root, folder)):
        for path in pictures_below(place):
            plain = _plain(path.parts)
            beside = {part for part in path.relative_to(place).parts[:-1] if BESIDE_PHOTOGRAPHS.fullmatch(part.lower())}
            below[plain[-1]].append((path, plain, beside))
    fits: dict[Rule, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    for name in names:
        if not (parts := _parts(name)):
            continue
        wanted = _plain(parts)
        for path, plain, beside in below[wanted[-1]]:
            for kept in range(1, 1 + _common_end(wanted, plain)):
                dropped = len(wanted) - kept
                files = fits[Rule(path.parents[kept - 1], dropped)][name]
                if beside <= set(parts) and not set(wanted[:dropped][-1:]) & set(SPLIT_FOLDERS) and path not in files:
                    files.append(path)
    rules = {rule: _one_each(found) for rule, found in fits.items()}
    return {rule: found for rule, found in rules.items() if found and len(set(found.values())) == len(found)}


def _one_each(found: dict[str, list[Path]]) -> dict[str, Path]:
    """Return the one file that fits each name: of several the one whose ending does, too."""
    chosen = {}
    for name, paths in found.items():
        alike = [path for path in paths if path.suffix.lower() == Path(name).suffix.lower()]
        for few in (paths, alike):
            if len(few) == 1:
                chosen[name] = few[0]
    return chosen


def _common_end(a: tuple[str, ...], b: tuple[str, ...]) -> int:
    count = 0
    for one, other in zip(reversed(a), reversed(b), strict=False):
        if one != other:
            break
        count += 1
    return count


def _rank(rule: Rule, folder: Path, root: Path) -> tuple[int, bool, int]:
    """Return what makes one rule likelier than another that finds as many: the less is dropped the better."""
    below = rule.folder.relative_to(root).as_posix() if rule.folder.is_relative_to(root) else "."
    name = "" if below == "." else below.lower()
    place = PICTURE_FOLDERS.index(name) if name in PICTURE_FOLDERS else len(PICTURE_FOLDERS)
    return rule.dropped, rule.folder != folder, place
