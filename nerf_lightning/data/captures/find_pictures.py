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
"""Where photographs lie below a capture's folder, the likeliest first."""
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
"""Endings under which a picture may lie that is not read."""
CONVERT = "Files of this format are not read: convert all of them to PNG."
SPLIT_FOLDERS = ("train", "val", "test", "eval")
"""Names that tell pictures apart which are called alike: they are never dropped, nor taken for each other."""
BESIDE_PHOTOGRAPHS = re.compile(r"(masks?|depths?|normals?|segmentations?|semantics?|confidence)(_.*)?")
"""Folders of pictures that are no photographs."""
MASK_ENDING = re.compile(r"[._-]masks?$")
"""What a mask's name may have and its photograph's has not."""
DRIVE = re.compile(r"^[a-zA-Z]:")
ZEROS = re.compile(r"(?<![0-9])0+(?=[0-9])")
NUMBERS = re.compile(r"(\D*)(\d*)", re.ASCII)

log = logging.getLogger(__name__)


class Rule(NamedTuple):
    """How names become files."""

    folder: Path
    dropped: int
    """So many folders of the name are not there."""


def find_pictures(
    names: Sequence[str],
    folder: Path,
    root: Path,
    source: Path,
    outside: bool = False,
    beside: Collection[Path] | None = None,
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
        beside: the photographs, where what lies beside them is wanted: masks, which may be called with _mask, or depth
            maps. None: photographs are wanted, and one that is found by another name is named.

    Raises:
        InputError: two folders fit alike, and neither is called as a folder of photographs is.
    """
    inside = [Path(os.path.abspath(each)) for each in (root, folder)]
    exact = {
        name: path for name in names if (path := named_picture(folder, name, None if outside else inside, beside or ()))
    }
    if len(exact) == len(names):
        return exact
    others = [name for name in names if name not in exact]
    taken = {*exact.values(), *(beside or ())}
    rules = _rules(others, root, folder, beside, taken)
    if not rules and beside is not None:
        rules = _rules(others, root, folder, beside, taken, by_number=True)
    if exact:
        # Names are right as they are, and some files are missing; but their case or ending may differ, or the machine.
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
            f"{'scene=colmap scene.images=FOLDER' if beside is None else 'scene.masks=FOLDER'}."
        )
    found = rules[best]
    name, path = next(iter(found.items()))
    if beside is None:
        usual = _rank(best, folder, root)[2] < len(PICTURE_FOLDERS)
        log.log(
            logging.INFO if usual else logging.WARNING,
            "%s: %d of %d pictures are found under another name, such as %s for %s",
            *(source, len(found), len(names), path.relative_to(root) if path.is_relative_to(root) else path, name),
        )
    return {name: path for name in names if (path := exact.get(name) or found.get(name))}


def pictures_below(root: Path) -> list[Path]:
    """Return the picture files in a folder and its subfolders, hidden ones apart, in order of their names.

    Links are followed.
    """
    pictures = list[Path]()
    for base, folders, names in walk(root, through_links=True):
        folders[:] = [name for name in folders if not name.startswith(".")]
        pictures += [base / name for name in names if name.lower().endswith(ENDINGS) and not name.startswith(".")]
    # A HEIC beside a JPEG of its name is the original of it.
    others = {path.with_suffix("") for path in pictures if path.suffix.lower() not in HEIC_ENDINGS}
    return sorted(p for p in pictures if p.suffix.lower() not in HEIC_ENDINGS or p.with_suffix("") not in others)


def first_with_pictures(root: Path, folders: Sequence[str] = PICTURE_FOLDERS) -> Path | None:
    """Return the first of some folders below `root` that has pictures."""
    return next((root / name for name in folders if (root / name).is_dir() and pictures_below(root / name)), None)


def pictures_by_stem(folder: Path) -> dict[str, Path]:
    """Return the pictures of a folder by their names without ending, in order of these.

    Of several the one that lies highest counts, then the JPEG, which cameras write; others are named once.
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
    """Return the file that a name is of as it stands, where it lies inside of one of some folders and is not taken.

    instant-ngp and Blender leave endings out.
    """
    named = folder / name.replace("\\", "/")
    candidates = [named] if named.suffix.lower() in KNOWN_ENDINGS else []
    if named.suffix.lower() in HEIC_ENDINGS and "HEIF" not in decoders():  # a phone's JPEG beside it is read
        candidates = [*(named.with_suffix(ending) for ending in ENDINGS if ending not in HEIC_ENDINGS), *candidates]
    candidates += [named.with_name(named.name + ending) for ending in ENDINGS] if named.name else []
    allowed = (
        path
        for path in candidates
        if inside is None or any(Path(os.path.abspath(path)).is_relative_to(each) for each in inside)
    )
    return next((path for path in allowed if path not in taken and os.path.isfile(path)), None)


def why_absent(name: str, folder: Path, root: Path) -> str:
    """Return why no file is found by the name of a picture, and what to do.

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
    r"""Return whether a name begins at a root, of Windows too.

    >>> is_absolute("/home/a.jpg"), is_absolute(r"C:\a.jpg"), is_absolute("images/a.jpg")
    (True, True, False)
    """
    return PurePosixPath(name).is_absolute() or PureWindowsPath(name).is_absolute()


def _parts(name: str) -> tuple[str, ...]:
    plain = DRIVE.sub("", name.strip().replace("\\", "/")).lstrip("/")
    return tuple(part for part in PurePosixPath(plain).parts if part not in (".", ".."))


def _plain(parts: tuple[str, ...], by_number: bool = False) -> tuple[str, ...]:
    """Return parts of a path as they are compared: without ending and case, %20 or a space, and one form of letters.

    `by_number` compares numbers, too, whatever zeros they begin with.
    """
    *folders, last = (unicodedata.normalize("NFC", unquote(part)).casefold() for part in parts)
    while (stem := Path(last)).suffix in KNOWN_ENDINGS and stem.stem:  # masks are called 0001.jpg.png
        last = stem.stem
    return (*folders, ZEROS.sub("", last) if by_number else last)


def _rules(
    names: Sequence[str],
    root: Path,
    folder: Path,
    beside: Collection[Path] | None,
    taken: Collection[Path],
    by_number: bool = False,
) -> dict[Rule, dict[str, Path]]:
    """Return the files that each rule finds, where it finds another for every name, and none that is taken."""
    below = _by_plain_name(dict.fromkeys((root, folder)), beside is not None, taken, by_number)
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
    """Return the pictures below some folders, with their path as it is compared and the folders that they are in."""
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
    """Return whether a file in these folders can be what a name with those means, and not of another split or kind."""
    beside = {folder for folder in folders - wanted if BESIDE_PHOTOGRAPHS.fullmatch(folder)}
    splits = wanted & set(SPLIT_FOLDERS)
    return not beside and not (splits and folders & set(SPLIT_FOLDERS) - splits)


def numeric_order(names: Sequence[str]) -> list[str]:
    """Return names in order of the numbers in them.

    >>> numeric_order(["picture_10", "picture_2"])
    ['picture_2', 'picture_10']
    """
    return sorted(names, key=lambda name: [(text, int(digits or 0)) for text, digits in NUMBERS.findall(name)])


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
