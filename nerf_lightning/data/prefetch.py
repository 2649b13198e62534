"""Batches made ahead of time by a background thread, so that a step does not wait for them."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from nerf_lightning.types.rays import Batch

Place = tuple[int, int, int]
"""Attempt, rays seen in it, and rays of the batch: all that a batch depends on besides the config."""


def made_ahead(make: Callable[[int, int, int], Batch], current: Callable[[], Place]) -> Iterator[Batch]:
    """Return the batch of the current place, again and again, each made while the step before it runs.

    The thread makes what follows if the run goes on as it does. Where it goes elsewhere meanwhile (a restart, batches
    of another size), what was made is dropped, and the batch that is asked for is made on the spot: which rays
    follow is a function of the place alone, with or without this thread.

    Args:
        make: takes a place; called in both threads, perhaps at once. It must not enter numba's thread pool.
        current: the run's place.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="batches") as pool:
        guess: Place | None = None
        made: Future[Batch] | None = None
        while True:
            place = current()
            batch = made.result() if made is not None and place == guess else make(*place)
            attempt, rays_seen, batch_rays = place
            guess = (attempt, rays_seen + batch_rays, batch_rays)
            made = pool.submit(make, *guess)
            yield batch
