from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict


def test_keys_shapes_and_dtypes_of_the_targets(make_planner, make_model):
    model = make_model().float()
    model.version.fill_(17)
    planner = make_planner(model, warm_start=True)
    for batch_size in ((), (5,), (2, 3)):
        flags = torch.ones(*batch_size, 1, dtype=torch.bool)
        out = planner(TensorDict({"observation": torch.randn(*batch_size, 3), "is_init": flags}, batch_size=batch_size))
        assert set(out.keys(True, True)) == {*planner.out_keys, "observation", "is_init"}
        expected = {
            "action": ((2,), torch.float32),
            ("plan", "loc"): ((2,), torch.float32),
            ("plan", "scale"): ((2,), torch.float32),
            ("plan", "value"): ((1,), torch.float32),
            ("plan", "version"): ((1,), torch.int64),
            ("plan", "fallback"): ((1,), torch.bool),
            ("next", "plan_mean"): ((3, 2), torch.float32),
        }
        assert {key: (out[key].shape, out[key].dtype) for key in planner.out_keys} == {
            key: (batch_size + shape, dtype) for key, (shape, dtype) in expected.items()
        }
        assert out["plan", "version"].eq(17).all()
    model.version.add_(1)
    assert out["plan", "version"].eq(17).all()  # a record, not a view


def test_renamed_and_nested_keys(make_planner, states, run, expected_plan):
    planner = make_planner(
        warm_start=True,
        observation_key=("agent", "pixels"),
        action_key=("agent", "torque"),
        is_init_key="first",
        plan_mean_key=("agent", "carried"),
        plan_key=("agent", "target"),
    )
    observation, carried = states(4), torch.rand(4, 3, 2, dtype=torch.float64)
    td = TensorDict(
        {
            "agent": {"pixels": observation, "carried": carried},
            "first": torch.zeros(4, 1, dtype=torch.bool),
            "observation": states(4),
            "plan_mean": torch.rand(4, 3, 2),
        },
        batch_size=[4],
    )
    out, expected = run(planner, td), expected_plan(planner, observation, carried)
    assert planner.in_keys == [("agent", "pixels"), "first", ("agent", "carried")]
    assert set(planner.out_keys) <= set(out.keys(True, True))
    torch.testing.assert_close(out["agent", "torque"], expected.loc)
    torch.testing.assert_close(out["agent", "target", "value"].squeeze(-1), expected.value)
    torch.testing.assert_close(out["next", "agent", "carried"], expected.mean)
    assert set(out["agent", "target"].keys()) == {"loc", "scale", "value", "version", "fallback"}
    assert "action" not in out.keys()
    assert "plan" not in out.keys()


def test_nothing_that_was_passed_is_changed_in_place(make_planner, states):
    planner = make_planner(warm_start=True)
    td = TensorDict(
        {
            "observation": states(3),
            "is_init": torch.tensor([[True], [False], [True]]),
            "plan_mean": torch.rand(3, 3, 2, dtype=torch.float64),
        },
        batch_size=[3],
    )
    planner(td)  # a second call meets the outputs of the first
    noise = planner.draw_noise(3)
    tensors = {key: td[key] for key in td.keys(True, True)} | noise._asdict()
    before = {key: tensor.clone() for key, tensor in tensors.items()}
    versions = {key: tensor._version for key, tensor in tensors.items()}
    planner(td)
    planner.plan(td["observation"], td["plan_mean"], noise=noise)
    for key, tensor in tensors.items():
        assert torch.equal(tensor, before[key])
        assert tensor._version == versions[key]


def test_planning_returns_the_action_and_writes_nothing(make_planner, states, run):
    planner = make_planner(warm_start=True)
    td = TensorDict(
        {"observation": states(3), "is_init": torch.ones(3, 1, dtype=torch.bool), "next": {"x": torch.zeros(3)}},
        batch_size=[3],
    )
    before = td.clone()
    torch.manual_seed(0)
    action = planner.planning(td)
    assert set(td.keys(True, True)) == set(before.keys(True, True))
    assert torch.equal(action, run(planner, td)["action"])


def test_the_output_can_go_elsewhere(make_planner, states):
    planner = make_planner()
    td, out = TensorDict({"observation": states(3)}, batch_size=[3]), TensorDict(batch_size=[3])
    assert planner(td, tensordict_out=out) is out
    assert set(td.keys()) == {"observation"}
    assert set(out.keys(True, True)) == set(planner.out_keys)


def test_no_graph_is_built(make_planner, states):
    planner = make_planner(warm_start=True)
    observation = states(3).requires_grad_()
    out = planner(TensorDict({"observation": observation, "is_init": torch.ones(3, 1).bool()}, batch_size=[3]))
    plan = planner.plan(observation, trace=True)
    tensors = [*out.select(*planner.out_keys).values(True, True), *plan[:-1], *plan.trace]
    assert not any(tensor.requires_grad for tensor in tensors)


def test_a_missing_observation_is_named(make_planner, states):
    planner = make_planner(observation_key="pixels")
    with pytest.raises(
        KeyError, match=r"the planner needs 'pixels' \(or 'latent'\) in its input; pass observation_key="
    ):
        planner(TensorDict({"observation": states(2)}, batch_size=[2]))


@pytest.mark.parametrize("dtype", [torch.int64, torch.float32, torch.uint8])
def test_starts_of_episodes_are_read_from_any_kind_of_flag(make_planner, states, dtype):
    planner, found = make_planner(warm_start=True), []
    flags = torch.tensor([[True], [False], [True]])
    entries = {"observation": states(3), "plan_mean": torch.rand(3, 3, 2, dtype=torch.float64)}
    for kind in (torch.bool, dtype):
        torch.manual_seed(0)
        found.append(planner(TensorDict({**entries, "is_init": flags.to(kind)}, batch_size=[3]))["action"])
    assert torch.equal(*found)
