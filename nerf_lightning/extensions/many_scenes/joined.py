"""Several captures as one scene, for a model that learns to render any."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import fields
from typing import TypeVar

import torch
from jaxtyping import Shaped
from torch import Tensor

from nerf_lightning.data.captures.capture import common_lens_model
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.types.scene import Cameras, PixelStore, Scene

SPLITS = ("train", "val", "test", "sources")

Kind = TypeVar("Kind")


def joined(captures: Mapping[str, Scene], unseen: Collection[str], name: str) -> Scene:
    """Return captures as one scene, whose views are named CAPTURE/VIEW.

    Each capture keeps its own frame and units: the user's frame is the scene's, and the box contains all contents. If
    some captures are unseen, they are not trained on, and all held-out views are theirs; their training views serve to
    render their other views, and are among the `sources`.

    Args:
        captures: by name, in order.
        unseen: names of those that are never trained on.
        name: of the scene.

    Raises:
        InputError: there are no captures, or one model cannot handle all of them.
    """
    if not captures:
        raise InputError(f"The scene {name} joins no captures. Give scene.variants, scene.root or scene.unseen.")
    names, scenes = tuple(captures), list(captures.values())
    _require_alike(captures)
    first, lengths = scenes[0], [len(scene.view_names) for scene in scenes]
    pixels = _pixels([scene.pixels for scene in scenes])
    return Scene(
        name=name,
        cameras=_cameras([scene.cameras for scene in scenes]),
        pixels=pixels,
        near=torch.cat([scene.near for scene in scenes]),
        far=torch.cat([scene.far for scene in scenes]),
        aabb=torch.stack(
            [
                torch.stack([scene.aabb[0] for scene in scenes]).amin(dim=0),
                torch.stack([scene.aabb[1] for scene in scenes]).amax(dim=0),
            ]
        ),
        splits=_splits(captures, unseen),
        view_names=tuple(f"{name}/{view}" for name, scene in captures.items() for view in scene.view_names),
        background=first.background,
        to_user=torch.eye(4, dtype=torch.float64),
        space=first.space,
        capture_of=tuple(number for number, length in enumerate(lengths) for _ in range(length)),
        captures=names,
        protocol=_protocol([scene.protocol for scene in scenes]),
        truth=None,
        left_out=tuple(f"{name}/{view}" for name, scene in captures.items() for view in scene.left_out),
    )


def _require_alike(captures: Mapping[str, Scene]) -> None:
    """Refuse captures that differ in properties that a scene shares between all its views."""
    asked: dict[str, tuple[Callable[[Scene], str], str]] = {
        "space": (lambda scene: scene.space, "Read all of them in one (scene.space=bounded or contracted)"),
        "background": (lambda scene: scene.background, "Give one for all (scene.background=white)"),
    }
    for what, (kind, cure) in asked.items():
        groups = _grouped(captures, kind)
        if len(groups) > 1:
            raise _mixed(captures, what, groups, cure)
    lenses = _grouped(captures, lambda scene: scene.cameras.lens_model)
    if common_lens_model(set(lenses)) is None:
        raise _mixed(captures, "kind of lens", lenses, "Train on captures of one kind")


def _grouped(captures: Mapping[str, Scene], kind: Callable[[Scene], Kind]) -> dict[Kind, list[str]]:
    groups: dict[Kind, list[str]] = {}
    for name, scene in captures.items():
        groups.setdefault(kind(scene), []).append(name)
    return groups


def _mixed(captures: Mapping[str, Scene], what: str, groups: Mapping[Kind, list[str]], cure: str) -> InputError:
    each = "; ".join(f"{kind}: {listed(names, 3)}" for kind, names in groups.items())
    return InputError(
        f"{len(captures)} captures cannot be joined into one scene, because they differ in their {what} ({each}), and "
        f"a scene has only one. {cure}, or leave some of them out."
    )


def _cameras(each: Sequence[Cameras]) -> Cameras:
    tensors = {
        field.name: torch.cat([getattr(cameras, field.name) for cameras in each])
        for field in fields(Cameras)
        if isinstance(getattr(each[0], field.name), Tensor)
    }
    lens_model = common_lens_model({cameras.lens_model for cameras in each})
    assert lens_model is not None
    return Cameras(**tensors, lens_model=lens_model)


def _pixels(each: Sequence[PixelStore]) -> PixelStore:
    starts = torch.tensor([0, *(len(store.rgba) for store in each)]).cumsum(0)

    def whole(parts: Sequence[Shaped[Tensor, "..."]]) -> Shaped[Tensor, "..."]:
        return parts[0] if len(parts) == 1 else torch.cat(list(parts))

    masks = [store.mask for store in each]
    return PixelStore(
        rgba=whole([store.rgba for store in each]),
        offset=torch.cat([store.offset + start for store, start in zip(each, starts, strict=False)]),
        width=torch.cat([store.width for store in each]),
        height=torch.cat([store.height for store in each]),
        has_transparency=any(store.has_transparency for store in each),
        mask=None
        if all(mask is None for mask in masks)
        else torch.cat(
            [
                torch.ones(len(store.rgba), dtype=torch.uint8) if mask is None else mask
                for store, mask in zip(each, masks, strict=True)
            ]
        ),
    )


def _splits(captures: Mapping[str, Scene], unseen: Collection[str]) -> dict[str, tuple[int, ...]]:
    splits: dict[str, list[int]] = {split: [] for split in SPLITS}
    start = 0
    for name, scene in captures.items():
        for split, views in scene.splits.items():
            numbers = [start + view for view in views]
            if split == "train":
                splits["sources"] += numbers
            if (split == "train") == (name not in unseen) or not unseen:
                splits[split] += numbers
        start += len(scene.view_names)
    return {split: tuple(views) for split, views in splits.items()}


def _protocol(each: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """Return how the pixels were prepared; if captures differ, all of their values."""
    keys = dict.fromkeys(key for protocol in each for key in protocol)
    return {key: "; ".join(dict.fromkeys(protocol.get(key, "none") for protocol in each)) for key in keys}
