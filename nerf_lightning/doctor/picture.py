"""Show an examined capture: one line, its cameras with the verdicts, and the proofs of the verdicts.

A ray through a detail of one photograph is a line in another. With the right poses the line passes through the same
detail.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.doctor.check import Analysis, Check
from nerf_lightning.doctor.epipolar import line_distances, places, rays_of
from nerf_lightning.doctor.extent import clear_matches
from nerf_lightning.doctor.features import small_picture
from nerf_lightning.doctor.matches import Matches, Proof
from nerf_lightning.nerf.geometry.cameras import camera_coordinates, project, resized
from nerf_lightning.nerf.types.scene import Cameras, Scene
from nerf_lightning.visualization.camera_layout import MOST_POINTS, draw_coverage, draw_layout
from nerf_lightning.visualization.figures import new_figure, picture_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDEST = 130
VERDICTS = {"ok": "#3c9d6b", "look": "#d9a400", "wrong": "#c8372d", "not judged": "0.5"}
MOST_PROOFS, MOST_DETAILS = 4, 7
COLORS = ("#ff2d2d", "#ffd500", "#2dff5a", "#2dd5ff", "#ff7bf2", "#ff9a2d", "#b39dff")
# Longer side of a photograph in pixels, and that of a row of the picture.
LONGER_SIDE, PANEL = 600, 480
# In units of the distance between both cameras: the drawn part of a ray.
NEAREST, FARTHEST, STEPS = -1.5, 3.0, 400


def about_capture(scene: Scene, source: str | None, form: str) -> str:
    """Return one line about what was examined: the folder, its format, the number and size of photographs.

    `source` is the folder or file that it was read from, if any, and `form` the name of the format for scene=.
    """
    pixels = scene.pixels
    sizes = sorted(set(zip(pixels.width.tolist(), pixels.height.tolist(), strict=True)))
    largest = "{} x {}".format(*sizes[-1])
    read = f"of {largest}" if len(sizes) == 1 else f"of {len(sizes)} sizes up to {largest}"
    splits = shares(scene.splits, len(scene.view_names))
    return f"{source or scene.name}: scene={form}, {len(scene.view_names)} photographs {read} ({splits})"


def shares(splits: Mapping[str, Sequence[int]], num_views: int) -> str:
    """Return how the views are split; the numbers add up to all of them.

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


def doctor_picture(
    analysis: Analysis, checks: Sequence[Check], about: str, width: int = 1500, height: int = 1150
) -> UInt8[Tensor, "height width 3"]:
    """Return the cameras from above and from the side, the coverage map and the verdicts; `about` is the title."""
    figure = new_figure(width, height)
    grid = figure.add_gridspec(2, 2, height_ratios=[1.25, 1.0], width_ratios=[1.0, 1.0])
    scene, content, what = analysis.scene, analysis.scene.points, "sparse points"
    if not len(content):
        content = places(analysis.matches, scene.cameras.c2w)[clear_matches(analysis)]
        what = "matched details"
    content = content[:: max(1, -(-len(content) // MOST_POINTS))]
    draw_layout(figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1]), scene, content)
    draw_coverage(figure.add_subplot(grid[1, 0]), scene)
    _write_verdicts(figure.add_subplot(grid[1, 1]), checks)
    title = about if len(about) <= WIDEST else f"... {about[-WIDEST:]}"
    title += f"\n{len(content)} {what}, space {scene.space}"
    figure.suptitle(title, fontsize=12, weight="bold", parse_math=False)
    return picture_of(figure)


def _write_verdicts(axes: "Axes", checks: Sequence[Check]) -> None:
    axes.set_axis_off()
    axes.set_title("verdicts", fontsize=11)
    step = 1.0 / max(len(checks), 1)
    for row, check in enumerate(checks):
        y = 1.0 - (row + 0.5) * step
        axes.text(0.0, y, check.verdict, color=VERDICTS[check.verdict], fontsize=8.5, weight="bold", va="center")
        axes.text(0.13, y, check.name, fontsize=8.5, va="center")
        text = check.message if len(check.message) <= 80 else check.message[:78].rstrip() + " ..."
        axes.text(0.38, y, text, fontsize=7.5, color="0.35", va="center", parse_math=False)
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)


def proof_picture(scene: Scene, proofs: Sequence[Proof]) -> UInt8[Tensor, "height width 3"]:
    """Return a row per proof: details of one photograph, and their lines in another with given and fitted cameras."""
    shown = proofs[:MOST_PROOFS]
    figure = new_figure(3 * PANEL, PANEL * len(shown) + 40)
    panels = figure.subplots(len(shown), 3, squeeze=False)
    longer = torch.maximum(scene.cameras.width, scene.cameras.height)
    scale = LONGER_SIDE / longer
    size = [(scale * side).round().long().clamp(min=1) for side in (scene.cameras.width, scene.cameras.height)]
    for row, proof in zip(panels, shown, strict=True):
        _draw_proof(row, replace(scene, cameras=resized(scene.cameras, *size)), proof, size)
    return picture_of(figure)


def _draw_proof(row: Sequence["Axes"], scene: Scene, proof: Proof, size: list[Tensor]) -> None:
    view, other = proof.matches.view[0].tolist()
    chosen = spread_out(proof.matches, MOST_DETAILS)
    names = [scene.view_names[each] for each in (view, other)]
    fits = None if proof.fits is None else resized(proof.fits, *size)
    titles = [
        f"{names[0]}: details that {names[1]} shows, too\n(each number is the same detail in both)",
        f"{names[1]}: they must lie on these lines, by the poses as given\n{_missed(proof.matches, scene.cameras)}",
    ]
    if fits is not None:
        zoom = float(fits.focal[view, 0] / scene.cameras.focal[view, 0])
        titles.append(f"{names[1]}: the lines by the poses that fit better\n{_missed(proof.matches, fits, zoom)}")
    for axes, title, shown in zip(row, titles, (view, other, other), strict=False):
        axes.imshow(
            small_picture(scene.pixels, shown, int(size[0][shown]), int(size[1][shown])).permute(1, 2, 0).numpy()
        )
        axes.set_title(title, fontsize=10, parse_math=False)
        axes.autoscale(False)
    for axes in row:
        axes.set_axis_off()
    _mark(row[0], _places_in(scene.cameras, chosen, 0))
    for axes, cameras in ((row[1], scene.cameras), (row[2], fits)):
        if cameras is not None:
            zoom = float(cameras.focal[view, 0] / scene.cameras.focal[view, 0])
            _draw_lines(axes, cameras, chosen, zoom)
            _mark(axes, _places_in(scene.cameras, chosen, 1))


def spread_out(matches: Matches, most: int) -> Matches:
    """Return a few matches that are far from each other in the first picture."""
    place, chosen = matches.plane[:, 0], [0]
    while len(chosen) < min(most, len(place)):
        apart = torch.cdist(place, place[chosen]).amin(dim=1)
        chosen.append(int(apart.argmax()))
    rows = torch.zeros(len(place), dtype=torch.bool)
    rows[chosen] = True
    return matches.where(rows)


def _missed(matches: Matches, cameras: Cameras, zoom: float = 1.0) -> str:
    off = float(line_distances(matches, cameras.c2w, zoom)[:, 1].median())
    return f"{len(matches.view)} details, off their lines by {off:.1f} pixels of 288 (median)"


def _places_in(cameras: Cameras, matches: Matches, side: int) -> Float[Tensor, "details 2"]:
    """Return the places of matched details in one of the two photographs, in pixels."""
    view, plane = int(matches.view[0, side]), matches.plane[:, side]
    local = torch.stack([plane[:, 0], -plane[:, 1], -torch.ones(len(plane))], dim=-1)
    return project(cameras, view, cameras.c2w[view, :, 3] + local @ cameras.c2w[view, :, :3].T)


def _mark(axes: "Axes", places: Float[Tensor, "details 2"]) -> None:
    for number, (x, y) in enumerate((places - 0.5).tolist()):
        color = COLORS[number % len(COLORS)]
        axes.plot(x, y, "o", markersize=9, markerfacecolor="none", markeredgecolor="black", markeredgewidth=3)
        axes.plot(x, y, "o", markersize=9, markerfacecolor="none", markeredgecolor=color, markeredgewidth=1.6)
        box = {"facecolor": "black", "alpha": 0.6, "pad": 1, "edgecolor": "none"}
        axes.annotate(str(number + 1), (x, y), (7, 7), textcoords="offset points", color=color, fontsize=9, bbox=box)


def _draw_lines(axes: "Axes", cameras: Cameras, matches: Matches, zoom: float) -> None:
    """Draw the rays through the first places as seen by the second camera."""
    view, other = matches.view[0].tolist()
    rays, baseline = rays_of(matches, cameras.c2w, zoom)
    along = float(baseline[0].norm()) * torch.logspace(NEAREST, FARTHEST, STEPS)
    points = cameras.c2w[view, :, 3] + along[:, None, None] * rays[:, 0].float()
    local = camera_coordinates(cameras, other, points)
    # Far outside the picture a lens may fold back, and places there are meaningless.
    plane = local[..., :2].abs() / -local[..., 2:]
    reach = torch.stack([cameras.width[other], cameras.height[other]]) / cameras.focal[other]
    drawn = (local[..., 2] < 0) & (cameras.lens_model == "fisheye" or (plane < 0.7 * reach).all(dim=-1))
    seen = torch.where(drawn[..., None], project(cameras, other, points) - 0.5, torch.nan)
    for number in range(len(rays)):
        x, y = seen[:, number].T.tolist()
        axes.plot(x, y, "-", color="black", linewidth=2.6, alpha=0.7)
        axes.plot(x, y, "-", color=COLORS[number % len(COLORS)], linewidth=1.3)
