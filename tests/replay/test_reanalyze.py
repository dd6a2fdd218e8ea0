from __future__ import annotations

import io

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    RandomSampler,
    SliceSampler,
    TensorDictReplayBuffer,
    TensorDictRoundRobinWriter,
)
from torchrl.envs import DoubleToFloat, ExplorationType, ObservationNorm
from torchrl.envs.utils import exploration_type, set_exploration_type

from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv, ReanalyzeTransform, StepSliceSampler, WorldModel

OBSERVATION_DIM, ACTION_DIM, SLICE_LEN = 3, 2, 3
TARGETS = [("plan", name) for name in ("loc", "scale", "value", "version")]


class CountingPlanner(TensorDictModuleBase):
    """Writes targets that no other row and no other call writes, and notes how it was called."""

    in_keys = ["observation"]
    out_keys = ["action", *TARGETS]

    def __init__(self, before_answering=None) -> None:
        super().__init__()
        self.calls: list[TensorDict] = []
        self.exploration_types: list[ExplorationType] = []
        self.before_answering = before_answering
        self.weight = torch.nn.Parameter(torch.zeros(1234))

    def forward(self, tensordict):
        self.calls.append(tensordict.clone())
        self.exploration_types.append(exploration_type())
        if self.before_answering is not None:
            self.before_answering()
        tags = 1000.0 * len(self.calls) + torch.arange(len(tensordict)).unsqueeze(-1) + self.weight.sum()
        tensordict["action"] = tags.expand(-1, ACTION_DIM).clone()
        tensordict["plan"] = TensorDict(
            {
                "loc": tags.expand(-1, ACTION_DIM).clone(),
                "scale": tags.expand(-1, ACTION_DIM) + 0.5,
                "value": -tags,
                "version": torch.full_like(tags, 50, dtype=torch.int64),
            },
            [len(tensordict)],
        )
        return tensordict


def rows(number: int, first: int = 0) -> TensorDict:
    """Transitions of episodes of ten steps; row i's observation and action are i, its targets i / 10."""
    count = torch.arange(first, first + number)
    column = count.float().unsqueeze(-1)
    return TensorDict(
        {
            "observation": column.expand(-1, OBSERVATION_DIM).clone(),
            "action": column.expand(-1, ACTION_DIM).clone(),
            "plan": {
                "loc": (column / 10).expand(-1, ACTION_DIM).clone(),
                "scale": (column / 10).expand(-1, ACTION_DIM) + 1,
                "value": column / 10,
                "version": (count % 7).unsqueeze(-1),
                "fallback": torch.zeros_like(column, dtype=torch.bool),
            },
            "collector": {"traj_ids": count // 10},
        },
        [number],
    )


def make_buffer(number: int, capacity: int = 40, num_slices: int = 4, storage=None, sampler=None, **options):
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity) if storage is None else storage,
        sampler=StepSliceSampler(SLICE_LEN) if sampler is None else sampler,
        writer=TensorDictRoundRobinWriter(track_generations=True),
        batch_size=num_slices * SLICE_LEN,
        **options,
    )
    buffer.extend(rows(number))
    return buffer


def make_reanalyze(buffer, planner=None, **options) -> ReanalyzeTransform:
    options = {"slice_len": SLICE_LEN, "interval": 1, "num_slices": 2} | options
    return ReanalyzeTransform(CountingPlanner() if planner is None else planner, **options).attach(buffer)


def make_planner(**options) -> EnsembleMPPIPlanner:
    torch.manual_seed(0)
    model = WorldModel(OBSERVATION_DIM, ACTION_DIM, latent_dim=16, mlp_dim=16, num_dynamics=2)
    for head in (model.reward_head, model.value_head):  # they start at zero, where every plan is as good as any other
        for parameter in head.parameters():
            torch.nn.init.normal_(parameter, std=0.3)
    options = {"num_samples": 16, "num_elites": 4, "num_proposals": 3, "iterations": 2, "warm_start": False} | options
    return EnsembleMPPIPlanner(LatentEnv(model), horizon=3, **options)


def content(buffer) -> TensorDict:
    return buffer.storage[:].clone()


def assert_only_targets_of(before: TensorDict, after: TensorDict, changed: torch.Tensor) -> None:
    """Bit-equal but for the targets of the rows ``changed``, every one of which differs."""
    assert set(before.keys(True, True)) == set(after.keys(True, True))
    for key in before.keys(True, True):
        different = (before[key] != after[key]).reshape(len(before), -1)
        if key in TARGETS:
            assert not different[~changed].any(), key
        else:
            assert not different.any(), key
    assert (before["plan", "loc"] != after["plan", "loc"]).any(-1)[changed].all()


def test_every_interval_th_sample_alone_is_planned():
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer, interval=3)
    calls = []
    for _ in range(10):
        buffer.sample()
        calls.append(len(reanalyze.planner.calls))
    assert calls == [0, 0, 1, 1, 1, 2, 2, 2, 3, 3]


@pytest.mark.parametrize("planner", [CountingPlanner, make_planner], ids=["counting", "ensemble-mppi"])
@pytest.mark.parametrize("memmap", [False, True], ids=["in-memory", "memmap"])
def test_the_first_slices_alone_are_renewed_in_the_batch_and_in_the_buffer(tmp_path, memmap, planner):
    storage = LazyMemmapStorage(40, scratch_dir=tmp_path) if memmap else None
    buffer = make_buffer(40, storage=storage)
    make_reanalyze(buffer, planner())
    torch.manual_seed(2)
    before = content(buffer)
    batch = buffer.sample()
    after = content(buffer)
    index, planned = batch["index"], 2 * SLICE_LEN

    original = before[index]
    for key in original.keys(True, True):
        equal = (batch[key] == original[key]).reshape(len(batch), -1)
        assert equal[planned:].all(), key
        if key in TARGETS[:3]:
            assert not equal[:planned].any(), key
        elif key not in TARGETS:
            assert equal.all(), key
    changed = torch.zeros(40, dtype=torch.bool)
    changed[index[:planned]] = True
    assert_only_targets_of(before, after, changed)
    for key in TARGETS:
        assert torch.equal(after[index[:planned]][key], batch[:planned][key]), key


def test_the_observations_of_the_first_slices_are_planned_in_one_call_and_nothing_else_is_passed():
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer)
    batch = buffer.sample()
    (states,) = reanalyze.planner.calls
    assert states.batch_size == (2 * SLICE_LEN,)
    assert list(states.keys(True, True)) == ["observation"]  # neither a warm start nor is_init
    assert torch.equal(states["observation"], batch["observation"][: 2 * SLICE_LEN])


def test_the_whole_sample_is_planned_if_it_has_fewer_slices_than_asked_for():
    buffer = make_buffer(40, num_slices=4)
    reanalyze = make_reanalyze(buffer, num_slices=20)
    batch = buffer.sample()
    assert len(reanalyze.planner.calls[0]) == 4 * SLICE_LEN
    assert (batch["plan", "version"] == 50).all()
    assert reanalyze.refreshed == 4 * SLICE_LEN


def test_every_copy_of_a_row_is_planned_and_all_get_one_target_in_the_batch_and_in_the_buffer():
    buffer = make_buffer(5, num_slices=8)
    reanalyze = make_reanalyze(buffer, num_slices=8)
    torch.manual_seed(0)
    for _ in range(20):
        batch = buffer.sample()
        index = batch["index"]
        assert len(index.unique()) < len(index)  # 24 rows out of 5
        for key in TARGETS:
            assert torch.equal(batch[key], content(buffer)[index][key]), key
    assert reanalyze.refreshed == 20 * 8 * SLICE_LEN
    assert {len(states) for states in reanalyze.planner.calls} == {8 * SLICE_LEN}  # one shape, for compiled planners


def test_the_caller_s_batch_is_independent_of_the_storage():
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer)
    batch = buffer.sample()
    before = content(buffer)
    batch["plan", "loc"].zero_()
    assert (content(buffer) == before).all()
    old = batch["plan", "scale"]
    kept = old.clone()
    reanalyze.refresh(batch)
    assert torch.equal(old, kept)  # a tensor taken from the batch earlier is not written to


def test_rows_overwritten_between_sample_and_refresh_are_left_alone_and_counted():
    buffer = make_buffer(40, capacity=40, num_slices=4)
    reanalyze = make_reanalyze(buffer, num_slices=4)
    reanalyze.enabled = False
    torch.manual_seed(0)
    sample = buffer.sample()
    buffer.extend(rows(20, first=40))  # rows 0..19 now hold others
    recycled = sample["index"] < 20
    assert 0 < recycled.sum() < len(sample)
    before = content(buffer)
    reanalyze.refresh(sample)
    changed = torch.zeros(40, dtype=torch.bool)
    changed[sample["index"][~recycled]] = True
    assert_only_targets_of(before, content(buffer), changed)
    assert reanalyze.stale == int(recycled.sum())
    assert reanalyze.refreshed == int((~recycled).sum())
    assert (sample["plan", "version"] == 50).all()  # the batch's states were planned all the same


def test_a_ring_that_wraps_exactly_once_makes_every_row_stale_and_stale_rows_add_up():
    buffer = make_buffer(40, num_slices=4)
    reanalyze = make_reanalyze(buffer, num_slices=4)
    reanalyze.enabled = False
    for turn in range(1, 4):
        sample = buffer.sample()
        buffer.extend(rows(40))  # the same content in the same rows, but other transitions
        before = content(buffer)
        reanalyze.refresh(sample)
        assert (content(buffer) == before).all()
        assert (reanalyze.refreshed, reanalyze.stale) == (0, turn * 4 * SLICE_LEN)


def test_rows_overwritten_during_the_planning_are_left_alone_and_counted():
    buffer = make_buffer(40, num_slices=4)
    newcomers = rows(20, first=40)
    planner = CountingPlanner(before_answering=lambda: buffer.extend(newcomers.clone()))
    reanalyze = make_reanalyze(buffer, planner, num_slices=4)
    torch.manual_seed(0)
    sample = buffer.sample()
    recycled = sample["index"] < 20
    assert 0 < recycled.sum() < len(sample)
    after = content(buffer)
    for key in newcomers.keys(True, True):
        assert torch.equal(after[key][:20], newcomers[key]), key
    assert (after["plan", "version"][sample["index"][~recycled]] == 50).all()
    assert reanalyze.stale == int(recycled.sum())
    assert reanalyze.refreshed == int((~recycled).sum())


def test_counts_add_up_over_samples():
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer, interval=2)
    for _ in range(6):
        buffer.sample()
    assert (reanalyze.refreshed, reanalyze.stale) == (3 * 2 * SLICE_LEN, 0)


def test_target_age_is_the_mean_age_before_the_refresh():
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer)
    assert reanalyze.target_age is None
    reanalyze.enabled = False
    sample = buffer.sample()
    expected = (50 - sample["plan", "version"][: 2 * SLICE_LEN]).float().mean()
    reanalyze.refresh(sample)
    assert reanalyze.target_age == expected
    reanalyze.refresh(sample)
    assert reanalyze.target_age == 0


def test_the_ensemble_planner_stamps_its_targets_with_the_number_of_updates():
    planner = make_planner()
    planner.world_model.version.fill_(11)
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer, planner)
    before = content(buffer)
    batch = buffer.sample()
    planned = batch["index"][: 2 * SLICE_LEN]
    assert (content(buffer)["plan", "version"][planned] == 11).all()
    assert reanalyze.target_age == (11 - before["plan", "version"][planned]).float().mean()


def test_nothing_is_planned_while_disabled_and_the_interval_starts_when_enabled():
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer, interval=2)
    reanalyze.enabled = False
    before = content(buffer)
    for _ in range(5):
        buffer.sample()
    assert not reanalyze.planner.calls
    assert (content(buffer) == before).all()
    reanalyze.enabled = True
    buffer.sample()
    assert not reanalyze.planner.calls
    buffer.sample()
    assert len(reanalyze.planner.calls) == 1


def test_a_single_row_that_is_read_is_no_sample():
    buffer = make_buffer(20)
    reanalyze = make_reanalyze(buffer)
    assert buffer[3]["plan", "value"].item() == pytest.approx(0.3)
    assert reanalyze.samples == len(reanalyze.planner.calls) == 0


@pytest.mark.parametrize("outside", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC, ExplorationType.MODE])
def test_the_planner_explores_whatever_the_caller_does(outside):
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer)
    with set_exploration_type(outside):
        buffer.sample()
        assert exploration_type() is outside
    assert reanalyze.planner.exploration_types == [ExplorationType.RANDOM]


@pytest.mark.parametrize("outside", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
def test_the_targets_are_the_cold_exploring_plans_of_the_ensemble_planner(outside):
    planner = make_planner(first_action="elite", eval_first_action="mean", num_elites=8)
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer, planner)
    reanalyze.enabled = False
    sample = buffer.sample()
    torch.manual_seed(5)
    expected = planner.plan(sample["observation"][: 2 * SLICE_LEN], explore=True)
    torch.manual_seed(5)
    evaluation = planner.plan(sample["observation"][: 2 * SLICE_LEN], explore=False)
    torch.manual_seed(5)
    with set_exploration_type(outside):
        reanalyze.refresh(sample)
    first = slice(None, 2 * SLICE_LEN)
    copies = (sample["index"][first].unsqueeze(0) == sample["index"][first].unsqueeze(1)).int().argmax(1)
    torch.testing.assert_close(sample["plan", "loc"][first], expected.loc[copies])
    torch.testing.assert_close(sample["plan", "scale"][first], expected.scale[copies])
    torch.testing.assert_close(sample["plan", "value"][first].squeeze(-1), expected.value[copies])
    assert (expected.loc != evaluation.loc).any()


def test_the_targets_follow_the_planner_s_present_weights():
    planner = make_planner()
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer, planner)
    reanalyze.enabled = False
    sample = buffer.sample()
    targets = []
    for _ in range(3):
        torch.manual_seed(1)
        targets.append(reanalyze.refresh(sample)["plan", "value"].clone())
        if len(targets) == 2:
            for parameter in planner.world_model.reward_head.parameters():
                parameter.data.add_(0.1 * torch.randn_like(parameter))
    assert torch.equal(targets[0], targets[1])
    assert (targets[1] != targets[2])[: 2 * SLICE_LEN].all()


def test_no_gradient_is_kept():
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer)
    batch = buffer.sample()
    assert reanalyze.planner(batch.clone())["plan", "loc"].requires_grad
    for rows_of in (batch, content(buffer)):
        assert not any(value.requires_grad for value in rows_of.values(True, True))


def test_the_sampler_still_draws_whole_slices():
    buffer = make_buffer(40)
    make_reanalyze(buffer)
    for _ in range(30):
        steps = buffer.sample()["observation"][:, 0].reshape(-1, SLICE_LEN)
        assert (steps.diff() == 1).all()


def test_other_keys_can_be_configured():
    planner = CountingPlanner()

    class Renamed(TensorDictModuleBase):
        in_keys, out_keys = [("obs", "state")], [("expert", "target")]

        def forward(self, tensordict):
            inner = planner(TensorDict({"observation": tensordict["obs", "state"]}, tensordict.batch_size))
            return tensordict.set(("expert", "target"), inner["plan"])

    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(40),
        sampler=StepSliceSampler(SLICE_LEN),
        writer=TensorDictRoundRobinWriter(track_generations=True),
        batch_size=6,
    )
    data = rows(40).rename_key_("observation", ("obs", "state")).rename_key_("plan", ("expert", "target"))
    buffer.extend(data)
    make_reanalyze(buffer, Renamed(), observation_key=("obs", "state"), plan_key=("expert", "target"))
    batch = buffer.sample()
    assert (batch["expert", "target", "version"] == 50).all()
    assert (content(buffer)["expert", "target", "version"][batch["index"]] == 50).all()


def test_the_buffer_s_state_holds_neither_the_planner_nor_the_transform_s_buffer(tmp_path):
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer, make_planner())
    assert list(reanalyze.parameters()) == list(reanalyze.buffers()) == list(reanalyze.children()) == []
    counts = {"samples": 0, "refreshed": 0, "stale": 0, "target_age": None}
    assert list(reanalyze.state_dict().values()) == [counts]
    saved = io.BytesIO()
    torch.save(buffer.state_dict(), saved)
    plain = io.BytesIO()
    torch.save(make_buffer(40).state_dict(), plain)
    assert abs(saved.getbuffer().nbytes - plain.getbuffer().nbytes) < 500
    buffer.dumps(tmp_path / "with")
    make_buffer(40).dumps(tmp_path / "without")
    files = [{str(path.relative_to(root)) for path in root.rglob("*")} for root in tmp_path.iterdir()]
    assert set.symmetric_difference(*files) == {"transform.t"}
    assert (tmp_path / "with" / "transform.t").stat().st_size < 2_000


@pytest.mark.parametrize("samples", [0, 3])
def test_the_counts_are_the_transforms_state_and_nothing_but_tensors_and_plain_values(samples):
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer, make_planner(), interval=2)
    for _ in range(samples):
        buffer.sample()
    assert (reanalyze.samples, reanalyze.target_age is None) == (samples, samples == 0)
    saved = io.BytesIO()
    torch.save({"part": reanalyze.state_dict(), "whole": buffer.state_dict()["_transforms"]}, saved)
    saved.seek(0)
    loaded = torch.load(saved, weights_only=True)
    for through in ("part", "whole"):
        other = make_buffer(40)
        fresh = make_reanalyze(other, make_planner(), interval=2)
        fresh.refreshed, fresh.target_age = 99, torch.tensor(1.0)
        (fresh if through == "part" else other.transform).load_state_dict(loaded[through])
        for name in ("samples", "refreshed", "stale", "target_age"):
            assert getattr(fresh, name) == getattr(reanalyze, name), name
        before = fresh.refreshed
        other.sample()  # its turn comes where it would have come
        assert (fresh.refreshed > before) == (samples == 3)


@pytest.mark.parametrize("through", ["state_dict", "dumps"])
def test_a_loaded_buffer_goes_on_being_reanalyzed(tmp_path, through):
    buffer, fresh = make_buffer(40), make_buffer(1)
    make_reanalyze(buffer)
    reanalyze = make_reanalyze(fresh, num_slices=4)
    buffer.extend(rows(7, first=40))
    if through == "state_dict":
        fresh.load_state_dict(buffer.state_dict())
    else:
        buffer.dumps(tmp_path)
        fresh.loads(tmp_path)
    batch = fresh.sample()
    assert (batch["plan", "version"] == 50).all()
    assert reanalyze.refreshed == 4 * SLICE_LEN
    assert (content(fresh)["plan", "version"][batch["index"]] == 50).all()
    assert (content(buffer)["plan", "version"] < 50).all()


def test_a_random_sampler_s_rows_can_be_reanalyzed_too():
    buffer = make_buffer(40, sampler=RandomSampler())
    make_reanalyze(buffer)
    batch = buffer.sample()
    assert ((batch["plan", "version"] == 50).flatten() == (torch.arange(12) < 6)).all()


def test_a_buffer_whose_writer_does_not_track_generations_is_refused():
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(40), writer=TensorDictRoundRobinWriter(), batch_size=6)
    with pytest.raises(ValueError, match=r"writer=TensorDictRoundRobinWriter\(track_generations=True\)"):
        make_reanalyze(buffer)
    assert len(buffer.transform) == 0


def test_a_buffer_that_prefetches_is_refused():
    with pytest.raises(ValueError, match="build the buffer without prefetch"):
        make_reanalyze(make_buffer(40, prefetch=2))


def test_a_transform_without_a_buffer_says_how_to_attach_it():
    sample = make_buffer(40).sample()
    reanalyze = ReanalyzeTransform(CountingPlanner(), slice_len=SLICE_LEN, interval=1)
    with pytest.raises(RuntimeError, match=r"use reanalyze.attach\(replay_buffer\)"):
        reanalyze.refresh(sample)


def test_a_sample_without_the_observation_is_refused():
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer)
    with pytest.raises(KeyError, match="needs the observation 'observation' in the sample; store it, or name it by"):
        reanalyze.refresh(buffer.sample().exclude("observation"))


@pytest.mark.parametrize("missing", ["index", *TARGETS])
def test_a_sample_without_targets_or_index_is_refused(missing):
    buffer = make_buffer(40)
    reanalyze = make_reanalyze(buffer)
    sample = buffer.sample().exclude(missing)
    with pytest.raises(KeyError, match=r"needs 'index' and \('plan', 'loc'\), .* in the sample"):
        reanalyze.refresh(sample)
    assert len(reanalyze.planner.calls) == 1  # that of buffer.sample()


@pytest.mark.parametrize(
    "sampler",
    [
        StepSliceSampler(SLICE_LEN),
        SliceSampler(slice_len=SLICE_LEN, traj_key=("collector", "traj_ids")),
        SliceSampler(num_slices=4, traj_key=("collector", "traj_ids")),
    ],
    ids=["ours", "slice_len", "num_slices"],
)
def test_slices_of_another_length_than_the_sampler_s_are_refused(sampler):
    buffer = make_buffer(40, sampler=sampler)
    with pytest.raises(ValueError, match=rf"slice_len=4 of reanalyze is not .*, 3, .* pass slice_len={SLICE_LEN}\."):
        make_reanalyze(buffer, slice_len=4)
    make_reanalyze(buffer, slice_len=SLICE_LEN)


@pytest.mark.parametrize("name", ["slice_len", "interval", "num_slices"])
def test_numbers_below_one_are_refused(name):
    arguments = {"slice_len": 3, "interval": 1, "num_slices": 1} | {name: 0}
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
        ReanalyzeTransform(CountingPlanner(), **arguments)


def test_the_repr_says_what_is_re_planned_and_what_was():
    buffer = make_buffer(12)
    reanalyze = make_reanalyze(buffer, interval=2)
    assert "slice_len=3, interval=2, num_slices=2, enabled=True, samples=0, refreshed=0, stale=0" in repr(reanalyze)
    buffer.sample(), buffer.sample()
    assert "samples=2, refreshed=6, stale=0" in repr(reanalyze)


def test_a_sample_that_comes_as_slices_is_refreshed_like_a_flat_one():
    results = []
    for as_slices in (False, True):
        torch.manual_seed(0)
        buffer = make_buffer(12, sampler=StepSliceSampler(SLICE_LEN, as_slices=as_slices))
        reanalyze = make_reanalyze(buffer)
        results.append((buffer.sample().reshape(-1), buffer.storage[:].clone(), reanalyze.refreshed))
    (flat, stored, count), (shaped, stored_too, count_too) = results
    assert (flat == shaped).all() and (stored == stored_too).all() and count == count_too == 6


def test_rows_that_hold_numbers_without_a_dimension_of_their_own_are_renewed_too():
    shorter = rows(40)
    for name in ("value", "version"):
        shorter["plan", name] = shorter["plan", name].squeeze(-1)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(40),
        sampler=StepSliceSampler(SLICE_LEN),
        writer=TensorDictRoundRobinWriter(track_generations=True),
        batch_size=4 * SLICE_LEN,
    )
    buffer.extend(shorter)
    reanalyze = make_reanalyze(buffer)
    batch = buffer.sample()
    assert batch["plan", "value"].shape == batch["plan", "version"].shape == batch.batch_size
    renewed = slice(0, 2 * SLICE_LEN)
    assert torch.equal(batch["plan", "value"][renewed], -batch["plan", "loc"][renewed, 0])
    assert (batch["plan", "version"][renewed] == 50).all()
    assert torch.equal(batch["plan", "value"][renewed], content(buffer)[batch["index"]]["plan", "value"][renewed])
    assert reanalyze.target_age == (50 - batch["index"][renewed] % 7).float().mean()


def test_a_transform_serves_one_buffer():
    first, second = make_buffer(40), make_buffer(40)
    reanalyze = make_reanalyze(first)
    for buffer in (first, second):
        with pytest.raises(ValueError, match="has a buffer already .* make one for each buffer"):
            reanalyze.attach(buffer)
    before = second[:].clone()
    first.sample()
    assert (second[:] == before).all()


def test_a_storage_of_more_dimensions_is_refused():
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(40, ndim=2), writer=TensorDictRoundRobinWriter(track_generations=True), batch_size=6
    )
    with pytest.raises(ValueError, match=r"one-dimensional storage, got ndim=2; use LazyTensorStorage\(capacity\)"):
        make_reanalyze(buffer)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"plan_key": "target"}, r"the planner writes .*'action', .*, but reanalyze needs \('plan', 'loc'\)"),
        ({"observation_key": "seen"}, r"the planner reads 'seen', but reanalyze needs 'observation'; give it the pla"),
    ],
)
def test_a_planner_of_other_keys_is_refused_before_anything_is_sampled(options, text):
    with pytest.raises(ValueError, match=text):
        make_reanalyze(make_buffer(20), make_planner(**options))


def test_a_planner_that_leaves_out_its_targets_is_refused():
    with pytest.raises(ValueError, match="the planner writes 'action', but reanalyze needs"):
        make_reanalyze(make_buffer(20), make_planner().select_out_keys("action"))


def test_a_transform_that_would_change_what_was_planned_from_comes_first():
    scaled = {"loc": 0.0, "scale": 100.0, "in_keys": ["observation"], "standard_normal": False}
    buffer = make_buffer(20)
    buffer.append_transform(ObservationNorm(**scaled))
    make_reanalyze(buffer)
    buffer.append_transform(DoubleToFloat(in_keys=["action"]))
    buffer.append_transform(ObservationNorm(**scaled, out_keys=["scaled"]))  # reads it and leaves it as it is
    assert "scaled" in buffer.sample()
    late = make_buffer(20)
    make_reanalyze(late)
    late.append_transform(ObservationNorm(**scaled))
    before = content(late)
    with pytest.raises(RuntimeError, match="ObservationNorm changes 'observation' after reanalyze has planned from it"):
        late.sample()
    assert (content(late) == before).all()
    other = make_buffer(20)
    make_reanalyze(other)
    other.append_transform(ObservationNorm(**(scaled | {"in_keys": ["action"]}), out_keys=["observation"]))
    with pytest.raises(RuntimeError, match="ObservationNorm changes 'observation' after reanalyze has planned from it"):
        other.sample()
