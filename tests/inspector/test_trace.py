from __future__ import annotations

import dataclasses
import io
import json
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch

from torchrl_etdmpc.functional import adaptive_mixture, ensemble_mean, ensemble_variance
from torchrl_etdmpc.inspector import Cancelled, TraceError, add_simulation, load_trace, trace_plan
from torchrl_etdmpc.inspector.trace import principal_components
from torchrl_etdmpc.modules import ActionValueWorldModel, WorldModel
from torchrl_etdmpc.planners import EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.planners.imagination import imagined_returns
from torchrl_etdmpc.testing import LineWorld, LQRWorld

OBSERVATION = torch.tensor([0.1, -0.2, 0.3])


def make(model=None, **settings) -> EnsembleMPPIPlanner:
    if model is None:
        torch.manual_seed(0)
        model = WorldModel(3, 2, latent_dim=16, mlp_dim=16, num_dynamics=3)
    budget = {"horizon": 4, "num_samples": 24, "num_elites": 5, "num_proposals": 4, "iterations": 3}
    return EnsembleMPPIPlanner(LatentEnv(model), **budget | settings)


def plan_of(planner: EnsembleMPPIPlanner, seed: int = 0, **options):
    noise = planner.draw_noise(1, generator=torch.Generator().manual_seed(seed))
    return planner.plan(OBSERVATION[None], noise=noise, trace=True, **options)


def test_a_trace_holds_the_planner_s_own_numbers():
    planner = make()
    carried = torch.rand(4, 2) - 0.5
    trace = trace_plan(planner, OBSERVATION, plan_mean=carried, seed=3)
    plan = plan_of(planner, 3, plan_mean=carried[None], explore=False)
    for name in ("actions", "scores", "returns", "mean", "std"):
        assert np.array_equal(trace[name], getattr(plan.trace, name)[0].numpy()), name
    for name in ("action", "scale", "value"):
        assert np.array_equal(trace[name], getattr(plan, name)[0].numpy()), name
    assert np.array_equal(trace["chosen_actions"][0], trace["action"])
    assert trace["proposals"].tolist() == [True] * 4 + [False] * 20
    assert (trace.iterations, trace.horizon, trace.num_dynamics) == (3, 4, 3)
    best = np.sort(trace["scores"], axis=1)[:, ::-1][:, :5]
    assert np.array_equal(np.take_along_axis(trace["scores"], trace["elites"], 1), best)
    fitted = (trace["elite_weights"][0][:, None, None] * trace["actions"][0][trace["elites"][0]]).sum(0)
    np.testing.assert_allclose(fitted, trace["mean"][0], atol=1e-6)


@pytest.mark.parametrize("choice", ["elite", "mean", "best"])
@pytest.mark.parametrize("explore", [False, True])
def test_the_chosen_sequence_begins_with_the_planner_s_action(choice, explore):
    planner = make(first_action=choice, eval_first_action=choice)
    for weight in planner.world_model.parameters():  # those of rewards and values are zeros at first
        torch.nn.init.normal_(weight, std=0.3)
    trace = trace_plan(planner, OBSERVATION, explore=explore, seed=2)
    loc = plan_of(planner, 2, explore=explore).loc[0].numpy()
    assert np.array_equal(trace["chosen_actions"][0], loc)
    chosen = int(trace["chosen"])
    assert (chosen == -1) == (choice == "mean")
    if chosen >= 0:
        assert np.array_equal(trace["actions"][-1, chosen], trace["chosen_actions"])
        assert np.array_equal(trace["returns"][-1, chosen], trace["chosen_returns"])


@pytest.mark.parametrize("explore", [False, True])
def test_training_may_choose_otherwise_than_evaluation(explore):
    planner = make(first_action="mean", eval_first_action="best")
    trace = trace_plan(planner, OBSERVATION, explore=explore, seed=2)
    assert np.array_equal(trace["chosen_actions"][0], plan_of(planner, 2, explore=explore).loc[0].numpy())
    assert (int(trace["chosen"]) == -1) == explore


def test_of_the_elites_the_one_that_was_drawn_is_chosen():
    planner, places = make(eval_first_action="elite", inverse_temperature=0.0), set()
    for seed in range(4):
        trace = trace_plan(planner, OBSERVATION, seed=seed)
        assert np.array_equal(trace["chosen_actions"][0], plan_of(planner, seed, explore=False).loc[0].numpy())
        places.add(trace["elites"][-1].tolist().index(int(trace["chosen"])))
    assert len(places) > 1


def test_what_does_not_come_from_the_search_is_what_the_planner_would_say():
    planner = make()
    for weight in planner.world_model.parameters():  # those of rewards and values are zeros at first
        torch.nn.init.normal_(weight, std=0.3)
    trace = trace_plan(planner, OBSERVATION)
    model = planner.world_model
    latent = model.encode(OBSERVATION)
    assert np.allclose(trace["policy_action"], model.policy(latent)[0].detach(), atol=1e-6)
    assert np.allclose(trace["policy_scores"], trace["policy_returns"].mean((1, 2, 3)), atol=1e-5)
    for head in range(3):  # one policy, in one latent
        np.testing.assert_allclose(trace["policy_actions"][head, 0], trace["policy_action"], atol=1e-6)
    # The chosen rewards and the values behind them are the return table: its first depth is r + gamma V.
    after = model.next(latent[None], torch.from_numpy(trace["chosen_actions"][0]))  # [F, L]
    first = trace["chosen_rewards"][0][:, None] + planner.discount * model.values(after).detach().numpy()
    np.testing.assert_allclose(first, trace["chosen_returns"][0], atol=1e-4)


def test_the_policy_and_the_chosen_sequence_are_scored_in_the_dtype_of_the_candidates():
    model = make().world_model
    for weight in model.parameters():  # those of rewards and values are zeros at first
        torch.nn.init.normal_(weight, std=0.3)
    settings = {"eval_first_action": "mean", "score": "final"}
    trace = trace_plan(make(model, scoring_dtype="bfloat16", **settings), OBSERVATION)
    whole = trace_plan(make(model, **settings), OBSERVATION)["policy_returns"]
    latent = model.encode(OBSERVATION)[None].bfloat16()
    for weight in model.parameters():  # the bins stay as they are
        weight.data = weight.data.bfloat16()
    for name, actions in {"policy": trace["policy_actions"], "chosen": trace["chosen_actions"][None]}.items():
        options = {"discount": 0.99, "all_depths": False, "dtype": torch.float32}
        half = imagined_returns(model, latent, torch.from_numpy(actions)[None].bfloat16(), **options)[0]
        np.testing.assert_allclose(trace[f"{name}_returns"].reshape(half.shape), half.detach().numpy(), rtol=1e-6)
    assert not np.allclose(trace["policy_returns"], whole, rtol=1e-4)


def test_points_are_projections_of_each_head_s_latents():
    planner = make()
    trace = trace_plan(planner, OBSERVATION)
    model = planner.world_model
    latent = model.encode(OBSERVATION).expand(3, 1, -1)
    actions = torch.from_numpy(trace["actions"][1])
    for step in range(4):
        latent = model.next(latent, actions[:, step])
        expected = (latent.detach().numpy() - trace["centre"]) @ trace["basis"].T  # [F, N, C]
        np.testing.assert_allclose(trace["points"][1, :, step], expected.transpose(1, 0, 2), atol=1e-4)
        distance = (latent - latent.mean(0)).square().sum(-1).mean(0).sqrt().detach().numpy()
        np.testing.assert_allclose(trace["latent_spread"][1, :, step], distance, atol=1e-5)
    np.testing.assert_allclose(trace["basis"] @ trace["basis"].T, np.eye(3), atol=1e-5)
    assert np.all(np.diff(trace["explained"]) <= 1e-6)
    assert 0 < trace["explained"].sum() <= 1
    apart = []  # of all candidates in all iterations
    for actions in torch.from_numpy(trace["actions"]):
        latent = model.encode(OBSERVATION).expand(3, 1, -1)
        for step in range(4):
            latent = model.next(latent, actions[:, step])
            apart.append(latent.detach().numpy() - trace["centre"])
    shown = np.square(trace["points"]).sum((0, 1, 2, 3)) / np.square(apart).sum()
    np.testing.assert_allclose(trace["explained"], shown, rtol=1e-3)


def test_components_find_the_plane_that_points_lie_in():
    flat = torch.randn(500, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([5.0, 1.0])
    plane, _ = torch.linalg.qr(torch.randn(6, 2, generator=torch.Generator().manual_seed(1)))
    components = principal_components(flat @ plane.mT + 3)
    back = components.project(flat @ plane.mT + 3)[:, :2] @ components.basis[:2] + components.centre
    torch.testing.assert_close(back, flat @ plane.mT + 3, atol=1e-4, rtol=0)
    assert components.basis[0] @ plane[:, 0] > 0.99 or components.basis[0] @ plane[:, 0] < -0.99


def test_the_largest_entry_of_a_component_is_positive():
    for seed in range(5):
        rows = torch.randn(50, 6, generator=torch.Generator().manual_seed(seed))
        basis = principal_components(rows).basis
        assert (basis.gather(1, basis.abs().argmax(1, keepdim=True)) > 0).all()


def test_the_mixture_is_there_with_the_adaptive_score_only():
    planner = make(score="adaptive", beta=1.0)
    trace = trace_plan(planner, OBSERVATION)
    returns = torch.from_numpy(trace["returns"])
    value, weights = adaptive_mixture(ensemble_mean(returns), ensemble_variance(returns).sqrt(), 1.0)
    # The same formula on another layout in memory, which a processor may add up in another order.
    np.testing.assert_allclose(trace["mixture"], weights.numpy(), rtol=1e-6)
    np.testing.assert_allclose(trace["scores"], value.numpy(), rtol=1e-6)
    assert trace_plan(make(), OBSERVATION).get("mixture") is None


def test_two_traces_can_share_their_plane():
    planner = make()
    first = trace_plan(planner, OBSERVATION)
    second = trace_plan(planner, OBSERVATION + 1, like=first)
    assert np.array_equal(first["basis"], second["basis"])
    assert not np.array_equal(first["basis"], trace_plan(planner, OBSERVATION + 1)["basis"])


@pytest.mark.parametrize("model", [LineWorld(num_dynamics=2), LQRWorld()])
def test_any_model_behind_the_protocol_can_be_traced(model):
    observation = torch.full((model.observation_dim,), 0.25)
    trace = trace_plan(make(model), observation)
    assert trace["points"].shape == (3, 24, 4, model.num_dynamics, min(3, model.latent_dim))


def test_a_model_without_a_policy_shows_none():
    class Bare(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            world = LineWorld()
            for name in ("observation_dim", "action_dim", "latent_dim", "num_dynamics", "version"):
                setattr(self, name, getattr(world, name))
            for name in ("encode", "next", "reward", "values", "termination"):
                setattr(self, name, getattr(world, name))

    trace = trace_plan(make(Bare(), num_proposals=0), torch.tensor([0.25]))
    assert [name for name in trace.arrays if name.startswith("policy")] == []
    assert not trace["proposals"].any()


def test_td_mpc2_s_critic_can_be_traced():
    model = ActionValueWorldModel(3, 2, latent_dim=16, mlp_dim=16, num_dynamics=1, num_values=3)
    trace = trace_plan(make(model, score="final"), OBSERVATION)
    assert trace["returns"].shape == (3, 24, 1, 1, 2)
    assert trace["policy_returns"].shape == (1, 1, 1, 3)


def test_when_no_score_is_finite_the_policy_is_chosen():
    planner = make(score=lambda returns: returns.sum((-3, -2, -1)) * torch.nan)
    trace = trace_plan(planner, OBSERVATION)
    assert trace.manifest["fallback"]
    assert int(trace["chosen"]) == -1
    np.testing.assert_allclose(trace["chosen_actions"][0], trace["policy_action"], atol=1e-6)
    assert np.array_equal(trace["action"], plan_of(planner, explore=False).action[0].numpy())


class Diverging(LineWorld):
    """A world in which some actions lead nowhere."""

    def next(self, latent, action):
        following = super().next(latent, action)
        return torch.where(action[..., :1] > 0.9, torch.nan, following)


def test_candidates_that_diverge_leave_the_others_where_they_are():
    trace = trace_plan(make(Diverging(num_dynamics=2)), torch.tensor([0.25]))
    there = np.isfinite(trace["points"]).all((2, 3, 4))
    assert there.any() and not there.all()
    assert np.array_equal(there, np.isfinite(trace["scores"]))
    assert np.take_along_axis(there, trace["elites"], 1).all()
    assert np.isfinite(trace["basis"]).all() and np.isfinite(trace["centre"]).all()
    assert trace["explained"].sum() == pytest.approx(1, abs=1e-5)  # of a line, by two components


def test_a_model_that_diverged_is_inspected_all_the_same():
    model = WorldModel(3, 2, latent_dim=16, mlp_dim=16)
    for parameter in model.parameters():
        torch.nn.init.constant_(parameter, torch.nan)
    trace = trace_plan(make(model), OBSERVATION)
    assert trace.manifest["fallback"]
    assert np.isnan(trace["points"]).all()
    assert not trace["explained"].any()


def test_tracing_leaves_planner_and_random_state_alone():
    planner = make()
    before, state = {name: value for name, value in vars(planner).items()}, torch.get_rng_state()
    trace_plan(planner, OBSERVATION, progress=lambda done, of: None)
    assert torch.equal(torch.get_rng_state(), state)
    assert vars(planner).keys() == before.keys()
    assert all(vars(planner)[name] is value for name, value in before.items())


def test_progress_is_told_between_iterations_and_can_end_the_call():
    told = []
    trace_plan(make(), OBSERVATION, progress=lambda done, of: told.append((done, of)))
    assert told == [(number, 6) for number in range(1, 7)]

    def give_up(done: int, of: int) -> None:
        if done == 2:
            raise Cancelled("enough")

    with pytest.raises(Cancelled, match="enough"):
        trace_plan(make(), OBSERVATION, progress=give_up)


def test_a_warm_start_of_another_horizon_is_cut_or_goes_on_with_zeros():
    carried = torch.full((3, 2), 0.5)
    assert trace_plan(make(), OBSERVATION, plan_mean=carried)["warm_start"][:, 0].tolist() == [0.5, 0.5, 0, 0]
    assert trace_plan(make(horizon=2), OBSERVATION, plan_mean=carried)["warm_start"][:, 0].tolist() == [0.5, 0]
    cold = trace_plan(make(warm_start=False), OBSERVATION, plan_mean=carried)
    assert not cold["warm_start"].any()
    assert trace_plan(make(initial="policy"), OBSERVATION, plan_mean=carried).get("warm_start") is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "either an observation or a latent of one state, got both or neither"),
        ({"observation": torch.zeros(4)}, r"observation must be one state of size 3.*got shape \[4\]"),
        ({"observation": torch.zeros(1, 3)}, r"got shape \[1, 3\]"),
        ({"latent": torch.zeros(5)}, r"latent must be one state of size 16, got shape \[5\]"),
        ({"observation": OBSERVATION, "plan_mean": torch.zeros(3, 7)}, r"plan_mean must have shape \[H, 2\]"),
    ],
)
def test_a_state_of_another_size_is_one_line(arguments, message):
    with pytest.raises(ValueError, match=message):
        trace_plan(make(), **arguments)


def test_the_simulator_s_side_is_projected_like_the_imagined_one():
    planner = make()
    trace = trace_plan(planner, OBSERVATION)
    observations = torch.randn(3, 3)
    seen = add_simulation(trace, torch.tensor([1.0, 2.0]), observations, None, planner.world_model)
    latents = planner.world_model.encode(observations).detach().numpy()
    np.testing.assert_allclose(seen["real_points"], (latents - trace["centre"]) @ trace["basis"].T, atol=1e-5)
    assert seen["real_rewards"].tolist() == [1, 2]
    assert "real_rewards" not in trace.arrays


def test_a_trace_comes_back_from_its_file(tmp_path):
    trace = trace_plan(make(), OBSERVATION, task="walker-walk", checkpoint={"sha256": "0" * 64})
    again = load_trace(trace.save(tmp_path / "new" / "trace.npz"))
    assert again.manifest == trace.manifest
    assert again.manifest["settings"]["horizon"] == 4
    assert again.arrays.keys() == trace.arrays.keys()
    assert all(np.array_equal(again[name], trace[name]) for name in trace.arrays)


@pytest.mark.parametrize("name", ["state", "checkpoint"])
def test_what_a_page_looks_up_by_name_is_refused_as_text_before_it_is_in_a_file(name):
    with pytest.raises(TraceError, match=f"^{name} in the manifest of a trace must be names with values, got 'mine'; "):
        trace_plan(make(), OBSERVATION, **{name: "mine"})


def test_a_trace_is_read_by_numpy_alone(tmp_path):
    trace = trace_plan(make(), OBSERVATION, task="walker-walk")
    path = trace.save(tmp_path / "trace.npz")
    script = (
        "import json, sys, numpy\n"
        "stored = numpy.load(sys.argv[1], allow_pickle=False)\n"
        "manifest = json.loads(str(stored['manifest']))\n"
        "print(manifest['format'], manifest['task'], *stored['points'].shape, 'torch' in sys.modules)\n"
    )
    command = [sys.executable, "-I", "-S", "-c", f"import sys; sys.path.append({np.__path__[0][:-6]!r})\n{script}"]
    run = subprocess.run([*command, str(path)], capture_output=True, text=True, check=False)
    assert run.stdout == "1 walker-walk 3 24 4 3 3 False\n", run.stderr


def rewritten(path, change) -> None:
    with np.load(path) as stored:
        arrays = dict(stored)
    manifest = json.loads(str(arrays["manifest"]))
    change(manifest, arrays)
    arrays["manifest"] = np.array(json.dumps(manifest))
    np.savez(path, **arrays)


def newer(manifest, arrays):
    manifest["format"] = 2


def foreign(manifest, arrays):
    manifest["kind"] = "something else"


def bare_manifest(manifest, arrays):
    del manifest["settings"]


def other_shape(manifest, arrays):
    arrays["scores"] = arrays["scores"][:, :-1]


def missing(manifest, arrays):
    del arrays["mean"]


def unknown(manifest, arrays):
    arrays["surprise"] = np.zeros(3)


def text(manifest, arrays):
    arrays["value"] = np.array("high")


def state_of_text(manifest, arrays):
    manifest["state"] = "x"


def nobody(manifest, arrays):
    arrays["elites"][0, 0] = 24


def less_than_nobody(manifest, arrays):
    arrays["chosen"] = np.array(-2)


def half_a_candidate(manifest, arrays):
    arrays["elites"] = arrays["elites"] + 0.5


def counted_proposals(manifest, arrays):
    arrays["proposals"] = np.full(24, 99)


def without_shares(manifest, arrays):
    del arrays["explained"]


def without_start(manifest, arrays):
    del arrays["start_point"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without_shares, "a trace with the array 'points' needs 'explained', which is missing"),
        (without_start, "a trace with the array 'chosen_points' needs 'start_point', which is missing"),
        (newer, "has trace format 2 and this version reads 1; use the version of"),
        (foreign, "is not a trace of torchrl_etdmpc; write one with"),
        (bare_manifest, "is not a whole trace: its manifest lacks settings"),
        (other_shape, r"scores of a trace must have shape \[3, 24\], got \[3, 23\]"),
        (missing, "a trace needs the array 'mean', which is missing"),
        (unknown, "a trace has no array 'surprise'"),
        (text, "value of a trace must hold numbers, got <U4"),
        (state_of_text, "is not a trace: state in the manifest of a trace must be names with values"),
        (nobody, r"elites of a trace must be whole numbers in \[0, 23\], its candidates"),
        (half_a_candidate, r"elites of a trace must be whole numbers in \[0, 23\], its candidates"),
        (less_than_nobody, r"chosen of a trace must be whole numbers in \[-1, 23\], its candidates"),
        (counted_proposals, "proposals of a trace must be true or false, got int64"),
    ],
)
def test_a_file_that_is_no_trace_of_this_format_is_one_line(tmp_path, change, message):
    path = trace_plan(make(), OBSERVATION).save(tmp_path / "trace.npz")
    rewritten(path, change)
    with pytest.raises(TraceError, match=message) as caught:
        load_trace(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04 cut off", None])
def test_a_file_that_is_no_archive_is_one_line(tmp_path, content):
    path = tmp_path / "trace.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(TraceError, match="is not a trace"):
        load_trace(path)


def test_whatever_bit_is_damaged_it_is_one_line(tmp_path):
    path = trace_plan(make(num_samples=8), OBSERVATION, task="walker-walk").save(tmp_path / "trace.npz")
    whole, refused = path.read_bytes(), 0
    flips = torch.randint(8 * len(whole), (400,), generator=torch.Generator().manual_seed(0)).tolist()
    for bit in (8 * 67, *flips, *range(0, 8 * 60, 3)):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            load_trace(path)  # where it says the same all the same
        except TraceError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > 200


def test_a_manifest_that_nests_without_end_is_one_line(tmp_path):
    np.savez(tmp_path / "trace.npz", manifest=np.array("[" * 100_000))
    with pytest.raises(TraceError, match="is not a trace"):
        load_trace(tmp_path / "trace.npz")


def test_an_array_that_promises_more_than_any_memory_holds_is_one_line(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**15,)})
    manifest = io.BytesIO()
    np.save(manifest, np.array(json.dumps(trace_plan(make(), OBSERVATION).manifest)))
    with zipfile.ZipFile(tmp_path / "trace.npz", "w") as archive:
        archive.writestr("manifest.npy", manifest.getvalue())
        archive.writestr("mean.npy", header.getvalue())
    with pytest.raises(TraceError, match="is not a trace"):
        load_trace(tmp_path / "trace.npz")


def test_code_in_a_file_is_not_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return (pytest.fail, ("code was run",))

    path = tmp_path / "trace.npz"
    trace = trace_plan(make(), OBSERVATION)
    np.savez(path, manifest=np.array(json.dumps(trace.manifest)), scores=np.array([Evil()], dtype=object))
    with pytest.raises(TraceError, match="is not a trace"):
        load_trace(path)


def test_a_trace_is_saved_under_a_name_that_says_so(tmp_path):
    with pytest.raises(ValueError, match=r"path of a trace must end in .npz"):
        trace_plan(make(), OBSERVATION).save(tmp_path / "trace.pt")


def test_a_trace_of_full_size_is_below_20_mb(tmp_path):
    """Of the largest action space of the benchmarks, with small networks: sizes do not depend on them."""
    model = WorldModel(3, 38, latent_dim=64, mlp_dim=16, encoder_dim=16, num_dynamics=4)
    planner = EnsembleMPPIPlanner(LatentEnv(model))  # the defaults are those of the full size: 512 candidates
    trace = trace_plan(planner, OBSERVATION)
    assert trace["actions"].shape == (8, 512, 6, 38)
    frames = np.random.default_rng(0).integers(0, 256, (7, 160, 160, 3), dtype=np.uint8)  # worse than any picture
    full = dataclasses.replace(trace, arrays={**trace.arrays, "frames": frames})
    assert full.save(tmp_path / "trace.npz").stat().st_size < 20e6
