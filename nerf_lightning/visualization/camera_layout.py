"""The camera layout of a capture, from above and from the side, and the directions from which the scene was seen."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nerf_lightning.nerf.geometry.world_frame import directions_seen, middle_of
from nerf_lightning.nerf.types.scene import Scene, SceneRecord
from nerf_lightning.visualization.figures import new_figure, picture_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = {"train": "#2f6db3", "held out": "#e07b39"}
CONTENT, BOX = "#8a8f98", "#3c9d6b"
SEEN, UNSEEN = "#cfe6d4", "#eceef1"
CELL, NEAR_ENOUGH = 3, 15.0  # Degrees of a cell of the coverage map, and within which of a camera it counts as seen
MOST_POINTS = 4000


def layout_picture(scene: Scene, width: int = 1200, height: int = 560) -> UInt8[Tensor, "height width 3"]:
    """Return the cameras from above and from the side, with what is known of the scene's content."""
    figure = new_figure(width, height)
    above, side = figure.subplots(1, 2)
    draw_layout(above, side, scene, scene.points[:: max(1, -(-len(scene.points) // MOST_POINTS))])
    return picture_of(figure)


def draw_layout(above: "Axes", side: "Axes", scene: Scene, content: Float[Tensor, "points 3"]) -> None:
    """Draw the cameras and the content from above and from the side."""
    flat = scene.space == "ndc"
    # In NDC's frame y is up and the cameras look along -z.
    _draw_cameras(above, scene, content, (0, 2) if flat else (0, 1), "from above")
    _draw_cameras(side, scene, content, (2, 1) if flat else (0, 2), "from the side")


def seen_cells(scene: SceneRecord) -> Bool[Tensor, "rows columns"]:
    """Return which cells of the map of directions, from azimuth and elevation -180, -90 on, a photograph is near."""
    columns = torch.arange(-180 + CELL / 2, 180, CELL)
    rows = torch.arange(-90 + CELL / 2, 90, CELL)
    cells = _unit(*torch.meshgrid(columns, rows, indexing="xy"))
    angle = (cells @ _unit(*directions_seen(scene)).T).clamp(-1, 1).amax(dim=-1).acos().rad2deg()
    return angle <= NEAR_ENOUGH


def draw_coverage(axes: "Axes", scene: SceneRecord) -> None:
    """Draw from which directions the scene was seen, and where photographs are missing."""
    from matplotlib.colors import ListedColormap

    if scene.space == "ndc":
        _draw_directions(axes, scene)
        return
    azimuth, elevation = directions_seen(scene)
    seen, colors = seen_cells(scene).numpy(), ListedColormap([UNSEEN, SEEN])
    placed: dict[str, Any] = {"extent": (-180, 180, -90, 90), "origin": "lower", "aspect": "auto"}
    axes.imshow(seen, cmap=colors, vmin=0, vmax=1, interpolation="nearest", **placed)
    for split, views in views_by_split(scene).items():
        at = list(views)
        dots: dict[str, Any] = {"s": 16, "color": COLOURS[split], "edgecolors": "white", "lw": 0.4, "label": split}
        axes.scatter(azimuth[at].numpy(), elevation[at].numpy(), **dots)
    axes.axhline(0, color="0.6", linewidth=0.7)
    axes.legend(loc="lower left", fontsize=7, framealpha=0.8)
    title = f"coverage: green is within {NEAR_ENOUGH:.0f} degrees of a photograph"
    axes.set_xticks(range(-180, 181, 45))
    axes.set_yticks(range(-90, 91, 30))
    _style(axes, title, "azimuth around the middle (degrees)", "elevation (degrees)")


def _draw_cameras(
    axes: "Axes", scene: Scene, content: Float[Tensor, "points 3"], dims: tuple[int, int], title: str
) -> None:
    from matplotlib.collections import LineCollection, PolyCollection

    centers = scene.cameras.c2w[:, :, 3]
    middle = middle_of(scene)
    size = float((centers - middle).norm(dim=-1).max().clamp(min=1e-6))
    x, y = content[:, dims].numpy().T
    axes.scatter(x, y, s=2.0, color=CONTENT, alpha=0.45, linewidths=0, zorder=1)
    if scene.space == "bounded":
        low, high = scene.aabb[:, dims].numpy()
        corners = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]
        axes.add_collection(PolyCollection([corners], facecolor="none", edgecolor=BOX, linewidth=1.6, label="box"))
    for split, views in views_by_split(scene).items():
        lines = np.concatenate([_frustum(scene, view, 0.13 * size)[:, :, dims] for view in views])
        axes.add_collection(LineCollection(list(lines), colors=COLOURS[split], linewidths=0.8, alpha=0.8, zorder=2))
        label = f"{split} ({len(views)})"
        x, y = centers[views][:, dims].numpy().T
        axes.scatter(x, y, s=9, color=COLOURS[split], label=label, zorder=3)
    everything = torch.cat([centers[:, dims], middle[None, dims]]).numpy()
    if scene.space == "bounded":
        everything = np.concatenate([everything, scene.aabb[:, dims].numpy()])
    if len(content):
        inner = content[:, dims].numpy()
        everything = np.concatenate([everything, np.quantile(inner, [0.03, 0.97], axis=0)])
    low, high = everything.min(axis=0) - 0.15 * size, everything.max(axis=0) + 0.15 * size
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    if dims == (0, 2) and scene.space == "ndc":
        axes.invert_yaxis()
    axes.set_aspect("equal", adjustable="box")
    axes.grid(True, color="0.93", linewidth=0.8, zorder=0)
    _style(axes, title, f"{'xyz'[dims[0]]} (scene units)", "xyz"[dims[1]])
    axes.legend(fontsize=8, loc="upper right", framealpha=0.9)


def _frustum(scene: Scene, view: int, length: float) -> Float[np.ndarray, "lines 2 3"]:
    """Return the eight edges of a view's frustum."""
    cameras = scene.cameras
    size = torch.stack([cameras.width[view], cameras.height[view]])
    ends = torch.stack([torch.zeros(2), size]).float()
    (left, top), (right, bottom) = ((ends - cameras.center[view]) / cameras.focal[view]).tolist()
    corners = torch.tensor([[left, -top, -1.0], [right, -top, -1.0], [right, -bottom, -1.0], [left, -bottom, -1.0]])
    corners = length * corners / corners.norm(dim=-1, keepdim=True)
    c2w = cameras.c2w[view]
    world = corners @ c2w[:, :3].T + c2w[:, 3]
    apex = c2w[:, 3].expand(4, 3)
    edges = [torch.stack([apex, world], dim=1), torch.stack([world, world.roll(-1, 0)], dim=1)]
    return torch.cat(edges).numpy()


def _draw_directions(axes: "Axes", scene: SceneRecord) -> None:
    # Forward-facing: what matters is the extent of the cameras' positions.
    x, y, _ = scene.cameras.c2w[:, :, 3].unbind(dim=-1)
    for split, views in views_by_split(scene).items():
        at = list(views)
        axes.scatter(x[at].numpy(), y[at].numpy(), s=30, color=COLOURS[split], edgecolors="white", lw=0.5)
    axes.set_aspect("equal", adjustable="box")
    axes.margins(0.2)
    axes.grid(True, color="0.93", linewidth=0.8)
    axes.set_axisbelow(True)
    _style(axes, "coverage: where the cameras stood, seen from behind them", "x (scene units)", "y")


def views_by_split(scene: SceneRecord) -> dict[str, list[int]]:
    """Return the training views and those held out for validation or test."""
    held = sorted(set(scene.splits.get("val", ())) | set(scene.splits.get("test", ())))
    return {"train": list(scene.splits["train"]), "held out": held}


def _unit(azimuth: Tensor, elevation: Tensor) -> Tensor:
    a, e = azimuth.deg2rad(), elevation.deg2rad()
    return torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()], dim=-1)


def _style(axes: "Axes", title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=11)
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.tick_params(labelsize=8, color="0.7")
    axes.spines[:].set_color("0.8")
