"""Find the files of a capture's picture names: one rule for all names of a file.

Files name pictures by absolute paths of another machine, relative to their parent's folder, with backslashes, or with
another extension than the actual one. All names of a file are changed in the same way: a number of leading folders is
dropped, and the rest is in one folder of the capture.
"""

import logging
import os
import re
import unicodedata
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import NamedTuple
from urllib.parse import unquote

from nerf_lightning.data.pixels.formats import HEIC_ENDINGS, UNREAD, decoders
from nerf_lightning.data.pixels.picture_files import ENDINGS
from nerf_lightning.files.walk import walk
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed

PICTURE_FOLDERS = ("images", "image", "rgb", "input", "", "images_2", "images_4", "images_8")
"""Folders of photographs below a capture's folder, the likeliest first."""
JPEG = (".jpg", ".jpeg")
KNOWN_ENDINGS = (*ENDINGS, *UNREAD, ".bmp")
NOT_READ = (
    *UNREAD,
    ".gif",
    ".bmp",
    ".tga",
    ".psd",
    ".hdr",
    ".ppm",
    ".pnm",
    ".svg",
    ".jp2",
    ".jxl",
    ".mp4",
    ".mov",
    ".zip",
)
"""Extensions of pictures that are not read."""
CONVERT = "Files of this format are not read: convert all of them to PNG."
SPLIT_FOLDERS = ("train", "val", "test", "eval")
"""Names that distinguish pictures of the same name: they are never dropped or exchanged."""
BESIDE_PHOTOGRAPHS = re.compile(r"(masks?|depths?|normals?|segmentations?|semantics?|confidence)(_.*)?")
"""Folders of pictures that are not photographs."""
MASK_ENDING = re.compile(r"[._-]masks?$")
"""What a mask's name may have in addition to its photograph's."""
DRIVE = re.compile(r"^[a-zA-Z]:")
ZEROS = re.compile(r"(?<![0-9])0+(?=[0-9])")
NUMBERS = re.compile(r"(\D*)(\d*)", re.ASCII)

log = logging.getLogger(__name__)


class Rule(NamedTuple):
    """How names become files."""

    folder: Path
    dropped: int
    """Number of leading folders of the name that do not exist."""


def find_pictures(
    names: Sequence[str],
    folder: Path,
    root: Path,
    source: Path,
    outside: bool = False,
    photographs: Collection[Path] | None = None,
) -> dict[str, Path]:
    """Return the file of each name; names without a match are absent.

    A name's own file in `folder` takes precedence. Otherwise the pictures below `root` are searched, and the rule that
    finds most is used. Case and extension may differ if only one file then matches.

    Args:
        names: as the capture has them.
        folder: what they are relative to.
        root: the capture's folder.
        source: the file that contains the names, for messages.
        outside: whether names may point outside `root` and `folder`.
        photographs: to find what belongs to them: masks, which may be called with _mask, or depth maps.
            None: find photographs, and log any that is found by another name.

    Raises:
        InputError: two folders match equally well, and neither has the name of a folder of photographs.
    """
    inside = [Path(os.path.abspath(each)) for each in (root, folder)]
    exact = {
        name: path
        for name in names
        if (path := named_picture(folder, name, None if outside else inside, photographs or ()))
    }
    if len(exact) == len(names):
        return exact
    others = [name for name in names if name not in exact]
    taken = {*exact.values(), *(photographs or ())}
    rules = _rules(others, root, folder, photographs, taken)
    if not rules and photographs is not None:
        rules = _rules(others, root, folder, photographs, taken, by_number=True)
    if exact:
        # The names are right, and some files are missing; but their case or extension may differ, or the machine.
        rules = {
            rule: found
            for rule, found in rules.items()
            if rule.folder == folder and (rule.dropped == 0 or all(map(is_absolute, found)))
        }
    if not rules:
        return exact
    most = max(map(len, rules.values()))
    best = min((rule for rule in rules if len(rules[rule]) == most), key=lambda rule: _rank(rule, folder, root))
    same = [
        rule for rule in rules if len(rules[rule]) == most and _rank(rule, folder, root) == _rank(best, folder, root)
    ]
    if len(same) > 1:
        raise InputError(
            f"{source} names pictures such as {names[0]}, which match files of {listed(rule.folder for rule in same)} "
            f"equally well. Move all but one of these folders out of {root}, or choose one with "
            f"{'scene=colmap scene.images=FOLDER' if photographs is None else 'scene.masks=FOLDER'}."
        )
    found = rules[best]
    name, path = next(iter(found.items()))
    if photographs is None:
        usual = _rank(best, folder, root)[2] < len(PICTURE_FOLDERS)
        log.log(
            logging.INFO if usual else logging.WARNING,
            "%s: %d of %d pictures are found under another name, such as %s for %s",
            *(source, len(found), len(names), path.relative_to(root) if path.is_relative_to(root) else path, name),
        )
    return {name: path for name in names if (path := exact.get(name) or found.get(name))}


def pictures_below(root: Path) -> list[Path]:
    """Return the picture files in a folder and its subfolders, except hidden ones, sorted by name.

    Links are followed.
    """
    pictures = list[Path]()
    for base, folders, names in walk(root, through_links=True):
        folders[:] = [name for name in folders if not name.startswith(".")]
        pictures += [base / name for name in names if name.lower().endswith(ENDINGS) and not name.startswith(".")]
    # A HEIC next to a JPEG of the same name is its original.
    others = {path.with_suffix("") for path in pictures if path.suffix.lower() not in HEIC_ENDINGS}
    return sorted(p for p in pictures if p.suffix.lower() not in HEIC_ENDINGS or p.with_suffix("") not in others)


def first_with_pictures(root: Path, folders: Sequence[str] = PICTURE_FOLDERS) -> Path | None:
    """Return the first of `folders` below `root` that contains pictures."""
    return next((root / name for name in folders if (root / name).is_dir() and pictures_below(root / name)), None)


def pictures_by_stem(folder: Path) -> dict[str, Path]:
    """Return the pictures of a folder by their names without extension, sorted by these.

    Of several, the one at the highest level counts, then the JPEG, which cameras write; others are logged once.
    """
    found, twins = dict[str, Path](), list[str]()
    likeliest = sorted(pictures_below(folder), key=lambda path: (len(path.parts), path.suffix.lower() not in JPEG))
    for path in likeliest:
        if found.setdefault(path.stem, path) is not path:
            twins.append(path.relative_to(folder).as_posix())
    if twins:
        log.warning("%s: %d pictures are left out as duplicates of others: %s", folder, len(twins), listed(twins, 3))
    return dict(sorted(found.items()))


def named_picture(
    folder: Path, name: str, inside: list[Path] | None = None, taken: Collection[Path] = ()
) -> Path | None:
    """Return the file that a name denotes as written, if it is inside one of the folders and is not taken.

    instant-ngp and Blender omit extensions.
    """
    named = folder / name.replace("\\", "/")
    candidates = [named] if named.suffix.lower() in KNOWN_ENDINGS else []
    if named.suffix.lower() in HEIC_ENDINGS and "HEIF" not in decoders():  # a phone's JPEG next to it is read
        candidates = [*(named.with_suffix(ending) for ending in ENDINGS if ending not in HEIC_ENDINGS), *candidates]
    candidates += [named.with_name(named.name + ending) for ending in ENDINGS] if named.name else []
    allowed = (
        path
        for path in candidates
        if inside is None or any(Path(os.path.abspath(path)).is_relative_to(each) for each in inside)
    )
    return next((path for path in allowed if path not in taken and os.path.isfile(path)), None)


def why_absent(name: str, folder: Path, root: Path) -> str:
    """Return why no file is found for the name of a picture, and what to do.

    Args:
        name: as the capture has it.
        folder: what it is relative to.
        root: the capture's folder.
    """
    if named_picture(folder, name):
        return (
            f"{name} leads out of the capture's folder {root} and is not followed, for safety. If this capture is "
            "yours, add scene.allow_outside=true; otherwise copy the picture into the folder."
        )
    if is_absolute(name):
        return (
            f"{name} is an absolute path of another machine, and no picture below {root} matches its end. Copy the "
            "pictures there, or set scene.images to their folder (scene=colmap)."
        )
    named = Path(os.path.abspath(folder / name.replace("\\", "/")))
    if any(named.is_relative_to(os.path.abspath(each)) for each in (root, folder)):
        for path in (named.with_suffix(cased) for ending in NOT_READ for cased in (ending, ending.upper())):
            if os.path.lexists(path):
                cure = UNREAD.get(path.suffix.lower(), CONVERT)
                return f"the image {named} does not exist, but {path.name} does. {cure}"
    return (
        f"the image {named} does not exist, and neither does one with another extension. Copy it there, or remove it "
        "from the capture's list."
    )


def is_absolute(name: str) -> bool:
    r"""Return whether a name begins at a root, including those of Windows.

    >>> is_absolute("/home/a.jpg"), is_absolute(r"C:\a.jpg"), is_absolute("images/a.jpg")
    (True, True, False)
    """
    return PurePosixPath(name).is_absolute() or PureWindowsPath(name).is_absolute()


def _parts(name: str) -> tuple[str, ...]:
    plain = DRIVE.sub("", name.strip().replace("\\", "/")).lstrip("/")
    return tuple(part for part in PurePosixPath(plain).parts if part not in (".", ".."))


def _plain(parts: tuple[str, ...], by_number: bool = False) -> tuple[str, ...]:
    """Return parts of a path normalized for comparison: without extension and case, %20 as a space, one Unicode form.

    `by_number` compares numbers, too, regardless of leading zeros.
    """
    *folders, last = (unicodedata.normalize("NFC", unquote(part)).casefold() for part in parts)
    while (stem := Path(last)).suffix in KNOWN_ENDINGS and stem.stem:  # masks are called 0001.jpg.png
        last = stem.stem
    return (*folders, ZEROS.sub("", last) if by_number else last)


def _rules(
    names: Sequence[str],
    root: Path,
    folder: Path,
    photographs: Collection[Path] | None,
    taken: Collection[Path],
    by_number: bool = False,
) -> dict[Rule, dict[str, Path]]:
    """Return the files that each rule finds, if it finds a different one for every name, and none that is taken."""
    below = _by_plain_name(dict.fromkeys((root, folder)), photographs is not None, taken, by_number)
    fits: dict[Rule, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    for name in names:
        if not (parts := _parts(name)):
            continue
        wanted = _plain(parts, by_number)
        for path, plain, folders in below[wanted[-1]]:
            if not _of_one_kind(set(wanted[:-1]), folders):
                continue
            for kept in range(1, 1 + _common_end(wanted, plain)):
                dropped = len(wanted) - kept
                files = fits[Rule(path.parents[kept - 1], dropped)][name]
                if not set(wanted[:dropped][-1:]) & set(SPLIT_FOLDERS) and path not in files:
                    files.append(path)
    rules = {rule: _one_each(found) for rule, found in fits.items()}
    return {rule: found for rule, found in rules.items() if found and len(set(found.values())) == len(found)}


def _by_plain_name(
    places: Iterable[Path], masks: bool, taken: Collection[Path], by_number: bool
) -> dict[str, list[tuple[Path, tuple[str, ...], set[str]]]]:
    """Return the pictures below some folders, with their normalized path and the folders that they are in."""
    below = defaultdict(list)
    for place in places:
        for path in pictures_below(place):
            if path in taken:
                continue
            plain, folders = (
                _plain(path.parts, by_number),
                {part.lower() for part in path.relative_to(place).parts[:-1]},
            )
            if masks:
                plain = (*plain[:-1], MASK_ENDING.sub("", plain[-1]))
            below[plain[-1]].append((path, plain, folders))
    return below


def _of_one_kind(wanted: set[str], folders: set[str]) -> bool:
    """Return whether a file in `folders` can match a name with folders `wanted`, being of the same split and kind."""
    beside = {folder for folder in folders - wanted if BESIDE_PHOTOGRAPHS.fullmatch(folder)}
    splits = wanted & set(SPLIT_FOLDERS)
    return not beside and not (splits and folders & set(SPLIT_FOLDERS) - splits)


def numeric_order(names: Sequence[str]) -> list[str]:
    """Return names sorted by the numbers in them.

    >>> numeric_order(["picture_10", "picture_2"])
    ['picture_2', 'picture_10']
    """
    return sorted(names, key=lambda name: [(text, int(digits or 0)) for text, digits in NUMBERS.findall(name)])


def _one_each(matches: dict[str, list[Path]]) -> dict[str, Path]:
    """Return the one file that matches each name: of several, the one whose extension matches, too."""
    chosen = {}
    for name, paths in matches.items():
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
    """Return the sort key of rules that find equally many: the less is dropped the better."""
    below = rule.folder.relative_to(root).as_posix() if rule.folder.is_relative_to(root) else "."
    name = "" if below == "." else below.lower()
    place = PICTURE_FOLDERS.index(name) if name in PICTURE_FOLDERS else len(PICTURE_FOLDERS)
    return rule.dropped, rule.folder != folder, place
