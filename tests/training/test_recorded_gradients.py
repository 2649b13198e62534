"""A recorded step is the step: `tests/support/tape.py` stands for CUDA graphs, with the torch twins of the kernels."""

from dataclasses import replace

import pytest
import torch
from support.gpu_training import step_by_step
from support.tape import replay_steps
from support.two_processes import in_two_processes

from nerf_lightning.data.ray_batches import gather_batch
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.corrections.base import NoCorrection
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.kernels.backends import CPU_BACKENDS, without
from nerf_lightning.nerf.kernels.threads import torch_on_one_thread
from nerf_lightning.nerf.losses.robust import RobustLoss
from nerf_lightning.nerf.part import statistics
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.types.rays import LazyBatch
from nerf_lightning.training.attempts import restart
from nerf_lightning.training.launch.trainer import TrainerSettings

CPU = torch.device("cpu")
KERNELS = CPU_BACKENDS
SETTING = "trainer.cuda_graph=true"
SMALL = ("encoder.num_levels=4", "encoder.log2_table_size=10", "model.levels.fine.sampler.update_every=4")


@pytest.fixture(autouse=True)
def as_on_a_gpu(monkeypatch):
    """Arrays of samples have a capacity, and torch does what numba would."""
    monkeypatch.setattr(OccupancySampler, "capacity_for", lambda sampler, rays: 8192)
    with without(*KERNELS), torch_on_one_thread():  # several add up gradients in any order
        yield


def trained(sizes, record, model="fast_small", *changes):
    """Take a step of each size, and return the run."""
    run = step_by_step(model, CPU, "32-true", None, *(changes or SMALL))
    for level in run.training.objective.model.levels.values():
        level.returns_weights = True  # so that no kernel takes whole rays
    if record:
        replay_steps(run.training)
    for size in sizes:
        run.training.progress.batch_rays = size
        run.step()
    return run


def assert_same(run, other):
    torch.testing.assert_close(run.all_losses(), other.all_losses(), rtol=0, atol=0)
    for name, value in run.training.objective.model.state_dict().items():
        torch.testing.assert_close(value, other.training.objective.model.state_dict()[name], rtol=0, atol=0, msg=name)


def test_recorded_steps_are_the_steps_bit_by_bit_across_updates_of_the_grid_and_for_each_size_of_batches():
    sizes = [48] * 6
    run = trained(sizes, record=True)
    assert_same(run, trained(sizes, record=False))
    assert [size for size, _ in run.training.gradients.recordings] == [48]
    assert statistics(run.training.objective.model)["train/dropped_samples"] == 0
    assert run.all_losses().unique().numel() == 6
    sizes = [32, 48, 32, 48, 48, 32]
    run = trained(sizes, record=True)
    assert_same(run, trained(sizes, record=False))
    assert sorted(size for size, _ in run.training.gradients.recordings) == [32, 48]


def trained_lazily(record, size=48, rank=0):
    """Take steps on batches that are gathered by numbers, and return the run."""
    run = trained([], record)
    run.training.progress.batch_rays = 48
    scene, domain = run.loader.scene, run.loader.whole

    def gather(numbers):
        batch = gather_batch(scene, domain.locate((numbers[0] + 7 * torch.arange(size)) % len(domain)))
        return replace(batch, weight=1.0 + (numbers[0] % 5) * torch.arange(size) / size)

    for first in (0, 900, 11):
        batch = LazyBatch(size, (first + 100 * rank,), "rays", gather, CPU)
        run.losses.append(run.training(batch, run.optimizer).losses.sum())
    return run


def test_a_replay_gathers_a_lazy_batch_by_its_own_numbers():
    run = trained_lazily(True)
    assert_same(run, trained_lazily(False))
    assert len(run.training.gradients.recordings) == 1
    assert run.all_losses().unique().numel() == 3


IN_TWO = """
from test_recorded_gradients import CPU_BACKENDS, OccupancySampler, trained, trained_lazily, without
OccupancySampler.capacity_for = lambda sampler, rays: 8192
with without(*CPU_BACKENDS):
    runs = [trained([48, 32, 48, 47], record) for record in (True, False)]
    lazy = [trained_lazily(record, 24, rank) for record in (True, False)]
sizes = [size for size, _ in runs[0].training.gradients.recordings]
replayed, taken = (
    [(run.all_losses(), run.training.objective.model.state_dict()) for run in each] for each in zip(runs, lazy)
)
weights = [each.detach() for run in (runs[0], lazy[0]) for each in run.training.objective.model.parameters()]
result = sizes, replayed, taken, weights
"""


@pytest.mark.minutes
def test_two_processes_that_replay_their_shares_learn_what_they_learn_without_and_the_same(tmp_path):
    one, other = in_two_processes(IN_TWO, tmp_path)
    for (sizes, replayed, taken, _), shares in ((one, [24, 16, 24]), (other, [24, 16, 23])):
        assert sizes == shares
        torch.testing.assert_close(replayed, taken, rtol=0, atol=0)
    assert all(map(torch.equal, one[-1], other[-1]))


def test_a_new_attempt_is_recorded_anew_since_what_it_took_up_may_lie_elsewhere():
    run, other = trained([48] * 3, record=True), trained([48] * 3, record=False)
    for each in (run, other):
        restart(each.training, each.optimizer)
        assert each is other or not each.training.gradients.recordings
        for _ in range(3):
            each.step()
    assert_same(run, other)


def test_what_the_host_decides_is_refused_by_name():
    run = step_by_step("fast_small", CPU)
    run.training.objective.loss = RobustLoss(run.training.objective.loss)
    encoder = next(each for each in run.training.objective.model.modules() if isinstance(each, HashGridEncoder))
    encoder.blend_in = 0.5
    with pytest.raises(InputError, match=rf"{SETTING}.*another step: HashGridEncoder, RobustLoss. Leave it out"):
        replay_steps(run.training)
    with pytest.raises(InputError, match=rf"{SETTING} is for NVIDIA GPUs, and this run computes on cpu"):
        TrainerSettings(accelerator="cpu", cuda_graph=True)


PROPOSALS = ("model.levels.proposal.learn_every=3", "+model.levels.proposal.learn_always=2")


@pytest.mark.parametrize(
    ("model", "changes", "variants"),
    [
        ("nerf_tiny", ("data.batch_rays=48",), 1),
        ("fast_proposal", ("encoder.log2_table_size=10", *PROPOSALS), 2),
        ("fast_small", (*SMALL, "correction=exposure"), 1),
    ],
)
def test_there_is_a_recording_for_each_variant_of_a_models_steps(model, changes, variants):
    run = trained([48] * 6, True, model, *changes)
    assert_same(run, trained([48] * 6, False, model, *changes))
    assert len(run.training.gradients.recordings) == variants


CAPTURING = RuntimeError("CUDA error: operation not permitted when stream is capturing\nSearch")


@pytest.mark.parametrize(
    ("error", "cause"),
    [(torch.OutOfMemoryError("full"), "there is no memory"), (CAPTURING, "stream is capturing. The")],
)
def test_what_cannot_be_recorded_is_computed_without(error, cause, caplog):
    def refused(work):
        work()  # which leaves gradients and counts behind
        raise error

    run = step_by_step("fast_small", CPU, "32-true", None, *SMALL)
    replay_steps(run.training, refused)
    for _ in range(3):
        run.step()
    assert [each.count(cause) for each in caplog.messages] == [1]
    assert not run.training.gradients.replays
    assert_same(run, trained([48] * 3, record=False))


def test_a_recorded_step_that_is_not_finite_changes_nothing_and_is_counted(monkeypatch):
    run = trained([48] * 3, record=True)
    before = {name: value.clone() for name, value in run.training.objective.model.named_parameters()}
    batch = run.loader.batch_at(0, 0)
    with monkeypatch.context() as patch:
        patch.setattr(
            run.loader, "batch_at", lambda *place: replace(batch, rgba=torch.full_like(batch.rgba, torch.nan))
        )
        run.step()
    assert run.training.guard.state() == [1, 1]
    for name, value in run.training.objective.model.named_parameters():
        torch.testing.assert_close(value, before[name], rtol=0, atol=0, msg=name)
    run.step()
    assert run.training.guard.state() == [1, 0]
    assert not torch.equal(run.training.objective.model.state_dict()[name], before[name])


@pytest.mark.parametrize(
    ("setting", "device", "compile", "model", "recorded"),
    [
        ("auto", "cuda", False, "fast_small", True),
        ("auto", "cuda", True, "fast_small", False),
        ("auto", "cpu", False, "fast_small", False),
        ("auto", "cuda", False, "fast_small,blend_in", False),
        (False, "cuda", False, "fast_small", False),
    ],
)
def test_steps_are_recorded_where_that_is_possible(setting, device, compile, model, recorded):
    name, *changes = model.split(",")
    train_step = step_by_step(name, CPU, "32-true", None, *(f"encoder.{change}=0.5" for change in changes)).training
    settings = TrainerSettings(accelerator="cpu", cuda_graph=setting, compile=compile)
    settings.device_type = device
    assert settings.records(train_step) is recorded
    train_step.objective.loss = type("Own", (type(train_step.objective.loss),), {"__module__": "my_parts"})()
    assert settings.records(train_step) is False


@pytest.mark.parametrize(("says", "auto"), [(True, True), (None, False), (False, False)])
def test_a_part_of_ones_own_says_itself_whether_it_can_be_replayed(says, auto):
    train_step = step_by_step("fast_small", CPU).training
    own = {"__module__": "my_parts"} | ({} if says is None else {"replays": says})
    train_step.objective.correction = type("Mood", (NoCorrection,), own)()
    settings = TrainerSettings(accelerator="cpu")
    settings.device_type = "cuda"
    assert settings.records(train_step) is auto
    if says is not False:
        return replay_steps(train_step)
    with pytest.raises(InputError, match=rf"{SETTING}.*another step: Mood\. Leave it out"):
        replay_steps(train_step)
