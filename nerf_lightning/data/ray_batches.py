"""Training batches: a stateless, keyed order over every pixel, and one vectorized gather per batch.

The order of rays is a permutation of all training pixels, new in each epoch and computed one batch at a time; only the
number of rays seen is stored, so a resumed run continues exactly where it stopped.

How many rays: `batch_rays` in conf/data/rays.yaml and conf/model/, adapted to `sample_budget` in one of the sizes of
`nerf/types/progress.py`. `kernels/pixels/cpu.py` and `cuda.py` gather the same pixels.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from nerf_lightning.compute import ranks
from nerf_lightning.data.depth_rays import DepthRays
from nerf_lightning.data.pixels.placement import sent
from nerf_lightning.data.target_views import rays_of_few_views
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.contrast import choose, shares
from nerf_lightning.nerf.geometry.cameras import all_pixels
from nerf_lightning.nerf.kernels.pixels.op import Domain, Order, has_kernel, ordered_batch
from nerf_lightning.nerf.kernels.threads import torch_on_one_thread
from nerf_lightning.nerf.randomness import fold, permute
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.nerf.types.rays import Batch, LazyBatch, PixelIndex
from nerf_lightning.nerf.types.scene import Scene
from nerf_lightning.nerf.types.tensor_struct import concatenate


class PixelDomain:
    """The pixels of some views, or of their centers, numbered from 0; row by row, view by view.

    If pixels come in squares, the squares are numbered instead. They form a grid that may be shifted against the
    picture; at its borders they are moved inside, so that together they cover every pixel for any shift. Squares near
    the borders may overlap.

    Args:
        scene: the views' sizes and offsets.
        views: the views to include, in order.
        fraction: share of each side, around the center, to include; 1 for the whole picture.
        patch: side of the squares in pixels, no longer than any picture's.
    """

    def __init__(self, scene: Scene, views: Sequence[int], fraction: float = 1.0, patch: int = 1):
        self.patch = patch
        self.views = torch.tensor(views, dtype=torch.int64, device=scene.pixels.width.device)
        width, height = scene.pixels.width[self.views], scene.pixels.height[self.views]
        self.width = (width * fraction).round().long().clamp(min=patch)
        self.height = (height * fraction).round().long().clamp(min=patch)
        self.left = (width - self.width) // 2
        self.top = (height - self.height) // 2
        # One more than fits, for what a shift uncovers on the other side.
        self.columns, self.rows = ((size + 2 * (patch - 1)) // patch for size in (self.width, self.height))
        self.sizes = self.columns * self.rows
        self.ends = self.sizes.cumsum(0)
        self.count = int(self.ends[-1])

    def __len__(self) -> int:
        return self.count

    @property
    def num_rays(self) -> int:
        """Number of rays that show every square once."""
        return self.count * self.patch**2

    def locate(self, number: Int[Tensor, "*rays"], shift: Int[Tensor, "*#rays"] | int = 0) -> PixelIndex:
        """Return the pixel and view of each number.

        Args:
            number: of pixels, or of squares, each of which returns all its pixels in one row.
            shift: of the grid of squares, in pixels, below `patch`.
        """
        slot = torch.searchsorted(self.ends, number, right=True)
        within = number - (self.ends[slot] - self.sizes[slot])
        row = torch.div(within, self.columns[slot], rounding_mode="floor")
        column = within - row * self.columns[slot]
        view, left, top = self.views[slot], self.left[slot], self.top[slot]
        if self.patch == 1:
            return PixelIndex(view=view, x=column + left, y=row + top)
        x, y = (
            (self.patch * place - shift).clamp(min=0).minimum(size[slot] - self.patch) + start
            for place, size, start in ((column, self.width, left), (row, self.height, top))
        )
        inside = torch.arange(self.patch, device=x.device)
        down, across = (part.flatten() for part in torch.meshgrid(inside, inside, indexing="ij"))
        return PixelIndex(
            view=view[..., None].expand(*view.shape, len(down)).flatten(),
            x=(x[..., None] + across).flatten(),
            y=(y[..., None] + down).flatten(),
        )


def gather_batch(scene: Scene, pixels: PixelIndex) -> Batch:
    """Return colors and weights of pixels."""
    store, mask = scene.pixels, scene.pixels.mask
    flat = store.index_of(pixels.view, pixels.x, pixels.y)
    return Batch(
        pixels=pixels,
        rgba=store.rgba[flat].to(torch.float32) / 255.0,
        weight=torch.ones(flat.shape, device=flat.device) if mask is None else mask[flat].to(torch.float32),
    )


class RayBatches:
    """The training loader: an iterable of `Batch` that reads its position from the run's progress.

    If a run has several processes, each gets its share of the one batch.

    Args:
        scene: where the pixels come from.
        progress: shared with the system, which advances it after each step.
        seed: the run's seed.
        batch_rays: rays per step.
        patch: side in pixels of the squares that rays come in; a batch consists of whole squares.
        views: number of photographs that the rays of a batch are from; None: all.
        depth_every: one in `depth_every` rays (or squares) passes through a pixel of known distance, if there are any;
            these come last in a batch. 0: none.
        candidates: pixels of which a ray shows one, in proportion to local contrast (`nerf.contrast`); 1: all pixels
            alike. Squares and rays of a few photographs have no candidates.
    """

    def __init__(
        self,
        scene: Scene,
        progress: Progress,
        seed: int,
        batch_rays: int,
        patch: int = 1,
        views: int | None = None,
        depth_every: int = 0,
        candidates: int = 1,
    ):
        self.progress, self.seed, self.batch_rays, self.patch, self.views = progress, seed, batch_rays, patch, views
        self.depth_every, self.candidates = depth_every, candidates if patch == 1 and views is None else 1
        progress.batch_rays = progress.largest_batch = batch_rays
        self.crop_fraction, self.crop_steps, self.restart_crop_steps = 1.0, 0, 0
        # The device for which a background thread makes batches; None: no such thread.
        self.prefetch_for: torch.device | None = None
        self.take_from(scene)
        self.num_steps = self.epoch_steps

    def take_from(self, scene: Scene) -> None:
        """Make batches from this copy of the scene, whose pixels are in memory, in a mapped file, or on a device."""
        self.scene = scene
        vars(self).pop("shares", None)  # those of pixels elsewhere
        self.whole = PixelDomain(scene, scene.splits["train"], patch=self.patch)
        self.crop = PixelDomain(scene, scene.splits["train"], self.crop_fraction, self.patch)
        depths = DepthRays(scene, self.patch) if self.depth_every and scene.depths is not None else None
        self.depths = depths if depths is not None and len(depths) else None

    @cached_property
    def shares(self) -> UInt8[Tensor, "pixels"] | None:
        """The shares of pixels among candidates (`nerf.contrast`), which the first batch waits for."""
        return shares(self.scene.pixels) if self.candidates > 1 else None

    def crop_to(self, fraction: float, steps: int, restart_steps: int) -> None:
        """Show only the pictures' centers at first; without this, runs on white backgrounds may never start learning.

        The crop is a separate domain and counts no epochs.

        Args:
            fraction: share of each side that the crop keeps.
            steps: its length in the first attempt.
            restart_steps: its minimum length in later attempts.
        """
        self.crop_fraction, self.crop_steps, self.restart_crop_steps = fraction, steps, max(steps, restart_steps)
        self.crop = PixelDomain(self.scene, self.scene.splits["train"], fraction, self.patch)

    def crop_rays(self, restarts: int) -> int:
        """Return how many rays a run takes from the crop after `restarts` restarts."""
        return self.batch_rays * (self.restart_crop_steps if restarts else self.crop_steps)

    @property
    def epoch_steps(self) -> int:
        """Number of steps that show as many rays as there are."""
        return -(-self.whole.num_rays // self.batch_rays)

    def __len__(self) -> int:
        # The batches are endless, but a trainer needs the length of an epoch: without it a batch would be fetched
        # ahead.
        return self.num_steps

    def __iter__(self) -> Iterator[Batch | LazyBatch]:
        device, progress = self.prefetch_for, self.progress
        if device is None:
            while True:
                # Steps are recorded on GPUs, and gather their batches themselves.
                lazy = self._has_kernel and self.whole.ends.is_cuda
                batch_at = self._in_one_kernel if lazy else self.batch_at
                yield batch_at(progress.attempt, progress.rays_seen)

        def make(*position: int) -> Batch:
            batch = self.batch_at(*position)
            return batch.map(Tensor.pin_memory) if device.type == "cuda" else batch

        for batch in made_ahead(make, lambda: (progress.attempt, progress.rays_seen, progress.batch_rays)):
            yield batch.to(device, non_blocking=device.type == "cuda")

    @torch_on_one_thread()
    def batch_at(self, attempt: int, rays_seen: int, batch_rays: int | None = None) -> Batch:
        """Return the batch after `rays_seen` rays of an attempt; `batch_rays` of None: the current batch size."""
        if self._has_kernel:
            return self._in_one_kernel(attempt, rays_seen, batch_rays).now()
        pixels, weight = self._drawn_at(attempt, rays_seen, batch_rays)
        batch = gather_batch(self.scene, pixels)
        if weight is not None:
            batch = replace(batch, weight=torch.cat([weight, batch.weight[len(weight) :]]))
        if self.depths is None:
            return batch
        return self.depths.with_depths(batch, self._depths_at(attempt, rays_seen, batch_rays))

    @property
    def _has_kernel(self) -> bool:
        return self.patch == 1 and self.views is None and has_kernel(self.whole.ends.device)

    def _in_one_kernel(self, attempt: int, rays_seen: int, batch_rays: int | None = None) -> LazyBatch:
        domain, purpose, _, places = self._places_at(attempt, rays_seen, batch_rays)
        rays = Order(places, len(domain), fold(self.seed, attempt, purpose), self.candidates)
        numbered = Domain(domain.ends, domain.width, domain.views, domain.left, domain.top)
        if self.depths is None:
            return ordered_batch(rays, numbered, self.scene.pixels, self.shares, kind=purpose)
        among, key = self._depth_places_at(rays_seen, batch_rays), fold(self.seed, attempt, "depths")
        of_known = Order(among, len(self.depths), key)
        return ordered_batch(rays, numbered, self.scene.pixels, self.shares, self.depths.depths, of_known, purpose)

    def pixels_at(self, attempt: int, rays_seen: int, batch_rays: int | None = None) -> PixelIndex:
        """Return this process's pixels of that batch."""
        return self._drawn_at(attempt, rays_seen, batch_rays)[0]

    def _drawn_at(
        self, attempt: int, rays_seen: int, batch_rays: int | None
    ) -> tuple[PixelIndex, Float[Tensor, "drawn"] | None]:
        """Return the pixels, and the weights of those that were chosen from candidates, which come first."""
        domain, purpose, together, places = self._places_at(attempt, rays_seen, batch_rays)
        if self.views is not None:
            key = fold(self.seed, attempt, purpose)
            starts, sizes = domain.ends.cpu() - domain.sizes.cpu(), domain.sizes.cpu()
            mine, count = torch.arange(places.start, places.stop) - together.start, len(together)
            numbers = rays_of_few_views(starts, sizes, together.start // count, mine, count, self.views, key)
            return domain.locate(sent(numbers, domain.ends.device)), None
        shift: Tensor | int = 0
        if self.patch > 1:  # each epoch has its own grid of squares, so that no pixel is always at a border
            shift = sent(self._epoch_keys(places, len(domain), attempt, purpose) % self.patch, domain.ends.device)
        every = range(places.start * self.candidates, places.stop * self.candidates)
        pixels, weight = domain.locate(self._in_order(every, len(domain), attempt, purpose), shift), None
        if self.candidates > 1:
            assert self.shares is not None
            key = fold(self.seed, attempt, purpose)
            pixels, weight = choose(self.scene.pixels, self.shares, pixels, places, key)
        if self.depths is not None:
            pixels = concatenate([pixels, self.depths.locate(self._depths_at(attempt, rays_seen, batch_rays))])
        return pixels, weight

    def _places_at(self, attempt: int, rays_seen: int, batch_rays: int | None) -> tuple[PixelDomain, str, range, range]:
        """Return the domain of that batch, its name, and positions in its order: the whole batch's, this process's."""
        position, count, slots = self._squares_at(rays_seen, batch_rays)
        before = self._num_depths(position)
        num_depths = self._num_depths(position + count) - before
        position, count = position - before, count - num_depths
        crop_squares = self.crop_rays(attempt - self.progress.rollbacks) // self.patch**2
        if position < crop_squares:
            domain, purpose = self.crop, "crop"
        else:
            domain, purpose, position = self.whole, "rays", position - crop_squares
        together = range(position, position + count)
        return domain, purpose, together, together[slots.start : slots.stop]

    def _depths_at(self, attempt: int, rays_seen: int, batch_rays: int | None) -> Int[Tensor, "squares"]:
        """Return this process's pixels of known distance in that batch."""
        assert self.depths is not None
        return self._in_order(self._depth_places_at(rays_seen, batch_rays), len(self.depths), attempt, "depths")

    def _depth_places_at(self, rays_seen: int, batch_rays: int | None) -> range:
        """Return their positions in the order of all pixels of known distance."""
        position, count, slots = self._squares_at(rays_seen, batch_rays)
        before = self._num_depths(position)
        first = count - (self._num_depths(position + count) - before)
        return range(before + max(slots.start - first, 0), before + max(slots.stop - first, 0))

    def _squares_at(self, rays_seen: int, batch_rays: int | None) -> tuple[int, int, range]:
        """Return the number of earlier squares, the number in the batch, and which of them are this process's."""
        count = (self.progress.batch_rays if batch_rays is None else batch_rays) // self.patch**2
        return rays_seen // self.patch**2, count, range(count)[ranks.share(count)]

    def _num_depths(self, squares: int) -> int:
        """Return how many of a run's first `squares` squares have a pixel of known distance."""
        return 0 if self.depths is None else squares // self.depth_every

    def _in_order(self, positions: range, size: int, attempt: int, purpose: str) -> Int[Tensor, "squares"]:
        """Return the number at each position (each below `size` once per epoch), on the device of the pixels."""
        keys = self._epoch_keys(positions, size, attempt, purpose)
        number = permute(torch.arange(positions.start, positions.stop) % size, size, keys)
        return sent(number, self.whole.ends.device)

    def _epoch_keys(self, positions: range, size: int, attempt: int, purpose: str) -> Int[Tensor, "*#squares"]:
        """Return the key of each position's epoch; a single one if all are in the same epoch."""
        epochs = range(positions.start // size, max(positions.stop - 1, positions.start) // size + 1)
        keys = torch.tensor([fold(self.seed, attempt, purpose, epoch) for epoch in epochs])
        if len(epochs) > 1:
            keys = keys[torch.arange(positions.start, positions.stop) // size - epochs.start]
        return keys


class FixedRays:
    """The validation loader: a fixed, evenly spread subset of a split's rays, the same for every run and seed.

    If a run has several processes, each gets its share.

    Args:
        scene: where the pixels come from.
        split: which views.
        num_rays: size of the subset; all rays of the split if it has fewer.
        chunk: rays per batch.

    Raises:
        InputError: the mask excludes the whole subset.
    """

    def __init__(self, scene: Scene, split: str, num_rays: int, chunk: int):
        self.scene = scene
        domain = PixelDomain(scene, scene.splits[split])
        count = min(num_rays, len(domain))
        numbers = permute(torch.arange(count), len(domain), torch.full((count,), fold("validation")))
        mine = numbers[ranks.share(count)].split(chunk)
        self.chunks = [domain.locate(sent(part, domain.ends.device)) for part in mine]
        if scene.pixels.mask is not None and not any(bool(batch.weight.any()) for batch in self):
            raise InputError(
                f"The masks of {scene.name} leave out all {count} pixels that validation looks at. "
                "Raise data.val_rays, or check the masks of the validation views (scene.masks_keep says which color "
                "counts)."
            )

    def __len__(self) -> int:
        return len(self.chunks)

    def __iter__(self) -> Iterator[Batch]:
        return (gather_batch(self.scene, pixels) for pixels in self.chunks)


class WholeViews:
    """The loader for tests and predictions: each view of a split as one batch, shaped like its picture.

    If a run has several processes, they take turns.

    Args:
        scene: where the pixels come from.
        split: which views.
    """

    def __init__(self, scene: Scene, split: str):
        self.scene = scene
        self.views = ranks.every_other(scene.splits.get(split, ()))

    def __len__(self) -> int:
        return len(self.views)

    def __iter__(self) -> Iterator[Batch]:
        return (gather_batch(self.scene, all_pixels(self.scene.cameras, view)) for view in self.views)


Position = tuple[int, int, int]
"""Attempt, rays seen in it, and rays of the batch: all that a batch depends on, besides the config."""


def made_ahead(make: Callable[[int, int, int], Batch], current: Callable[[], Position]) -> Iterator[Batch]:
    """Yield the batch of the current position, again and again, each made while the previous step runs.

    The thread makes the batch that follows if the run proceeds normally. If it does not (a restart, another batch
    size), that batch is dropped, and the requested one is made on the spot: which rays follow is a function of the
    position alone, with or without this thread.

    Args:
        make: takes a position; called in both threads, possibly at once.
        current: the run's position.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="batches") as pool:
        guess: Position | None = None
        made: Future[Batch] | None = None
        while True:
            position = current()
            batch = made.result() if made is not None and position == guess else make(*position)
            attempt, rays_seen, batch_rays = position
            guess = (attempt, rays_seen + batch_rays, batch_rays)
            made = pool.submit(make, *guess)
            yield batch
