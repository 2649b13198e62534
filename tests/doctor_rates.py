"""How often does each check of the doctor raise a false alarm, and how often does it find what is wrong?

    python tests/doctor_rates.py [SEEDS]

Examines the real captures at hand and, of every kind of support.brick_captures, SEEDS captures (25: 200 in all) whose
poses are exact; plants faults in the real ones and in some of bricks. Prints two tables in Markdown, and every `wrong`
of a sound capture. Ends with 1 where a capture of bricks with exact poses is called wrong.
"""

import sys
import time
from collections import Counter
from collections.abc import Iterator

from support.brick_captures import KINDS, brick_capture
from support.captures import REAL
from support.planted_poses import FAULTS, Found, plant

from nerf_lightning.data.readers.base import Reader
from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.data.readers.colmap import ColmapReader
from nerf_lightning.data.readers.llff import LlffReader
from nerf_lightning.data.readers.npz import NpzReader
from nerf_lightning.data.readers.transforms import TransformsReader
from nerf_lightning.doctor.examine import examine
from nerf_lightning.nerf.types.scene import Scene

SEEDS = 25
# Single views are drawn so often in each real capture; and of bricks, captures of so many seeds get faults.
DRAWN, PLANTED = 4, 3


def real_captures() -> Iterator[Scene]:
    """Yield those of the known captures that are here."""
    readers: dict[str, type[Reader]] = {"cup_colmap": ColmapReader, "fern": LlffReader, "fox": TransformsReader}
    readers |= dict.fromkeys(
        ("lego_200", *(f"extra_synthetic/{name}" for name in ("bike", "duck", "horse"))), BlenderReader
    )
    for name, reader in readers.items():
        if (REAL / name).is_dir():
            background = {"background": "black"} if "extra" in name else {}
            yield reader(root=str(REAL / name), name=name, **background).read()  # type: ignore[call-arg]
    if (REAL / "lego_tiny").is_dir():
        yield NpzReader(str(REAL / "lego_tiny" / "tiny_nerf_data.npz"), name="lego_tiny").read()


def captures(seeds: int) -> Iterator[tuple[str, int, Scene]]:
    """Yield the kind of a capture, how often single views are drawn in it to be spoilt, and the capture."""
    yield from (("real", DRAWN, scene) for scene in real_captures())
    for seed in range(seeds):
        yield from ((kind, int(seed < PLANTED), brick_capture(kind, seed)) for kind in KINDS)


def main() -> int:
    """Print the tables."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else SEEDS
    alarms: dict[str, Counter[tuple[str, str]]] = {}
    examined: Counter[str] = Counter()
    found: list[tuple[str, Found]] = []
    spent, views, false = 0.0, 0, 0
    for kind, drawn, scene in captures(seeds):
        began = time.process_time()
        analysis, checks = examine(scene)
        spent, views = spent + time.process_time() - began, views + len(scene.view_names)
        examined[kind] += 1
        for check in checks:
            alarms.setdefault(check.name, Counter())[kind, check.verdict] += 1
            if check.verdict == "wrong":
                false += kind != "real"
                print(f"wrong on exact poses: {scene.name}: {check.name}: {check.message}", flush=True)
        for fault in FAULTS:
            times = drawn if fault.startswith(("one", "two")) else min(drawn, 1)
            found += [(kind, plant(analysis, fault, seed)) for seed in range(times)]
    print_false_alarms(alarms, examined)
    print_found(found)
    print(f"\n{sum(examined.values())} captures, {1000 * spent / views:.0f} ms of processor time a view")
    return int(false > 0)


def print_false_alarms(alarms: dict[str, Counter[tuple[str, str]]], examined: Counter[str]) -> None:
    """Print how many sound captures each check calls `look` and `wrong`, per kind."""
    print("\nSound captures that a check calls look + wrong (a dot: none)\n")
    print("| check | " + " | ".join(f"{kind} ({count})" for kind, count in examined.items()) + " | wrong in all |")
    print("|---" * (len(examined) + 2) + "|")
    for name, counts in alarms.items():
        cells = [f"{counts[kind, 'look']} + {counts[kind, 'wrong']}" for kind in examined]
        total = sum(counts[kind, "wrong"] for kind in examined)
        row = " | ".join("." if cell == "0 + 0" else cell for cell in cells)
        print(f"| {name} | {row} | {100 * total / sum(examined.values()):.1f} % |")


def print_found(found: list[tuple[str, Found]]) -> None:
    """Print how many of the planted faults are found, in real captures and in those of bricks."""
    print("\nPlanted faults: called wrong (named: with every view) of all, and innocent views called wrong\n")
    print("| fault | real | named | innocent | bricks | named | innocent |\n|---|---|---|---|---|---|---|")
    for fault in FAULTS:
        cells = []
        for real in (True, False):
            those = [each for kind, each in found if each.fault == fault and (kind == "real") == real]
            count = max(len(those), 1)
            wrong, named = (100 * sum(getattr(each, name) for each in those) / count for name in ("wrong", "named"))
            cells += [f"{wrong:.0f} % of {len(those)}", f"{named:.0f} %", str(sum(each.accused for each in those))]
        print(f"| {fault} | {' | '.join(cells)} |")


if __name__ == "__main__":
    sys.exit(main())
