"""The planner as a LeRobot policy, in one process. What all planners share is tested in test_baselines.py."""

import warnings
from itertools import pairwise

import numpy as np
import pytest
import torch
from draccus.utils import ParsingError
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.constants import OBS_ENV_STATE
from torch.utils.data import default_collate

from lerobot_hdp import FREE, HDPConfig, PlanPrompt
from lerobot_hdp.configuration_hdp import OBS_SYMBOLIC_PLAN
from lerobot_hdp.denoiser import DecoderLayer
from lerobot_hdp.encoders import StateEncoder
from lerobot_hdp.modeling_hdp import HDPPolicy
from lerobot_hdp.processor_hdp import SymbolicPlanProcessorStep
from lerobot_hdp.prompt import encode_prompt

from .conftest import HORIZON, TINY_PLANNER, calls_of_network, observation, train_in_process


def test_sizes_and_vocabulary_come_from_the_dataset(make_planner):
    policy, *_ = make_planner()
    assert policy.config.symbolic_horizon == 18
    assert policy.config.vocabulary == ["PAD", "A", "B", "PICK", "PLACE", "S1", "S2", "AUX"]
    assert set(policy.config.input_features) == {"observation.state", "observation.environment_state"}


def test_each_object_is_a_condition_token_of_its_own(make_planner):
    assert make_planner()[0].config.observation_token_sizes == [3, 2, 2]
    assert make_planner(object_tokens=False)[0].config.observation_token_sizes == [7]


def test_names_that_are_not_of_components_tell_no_objects(dataset):
    """LeRobot's own datasets often name a whole vector: `"names": ["keypoints"]`."""
    features = {**dataset.meta.features}
    features["observation.environment_state"] = {**features["observation.environment_state"], "names": ["keypoints"]}
    config = HDPConfig(**TINY_PLANNER, device="cpu")
    config.input_features = {
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (4,)),
        "observation.state": PolicyFeature(FeatureType.STATE, (3,)),
    }
    config.set_dataset_feature_metadata(features)
    assert config.observation_token_sizes == [4, 3]


@pytest.mark.parametrize("hidden_dim", [0, 16])
@pytest.mark.parametrize("object_tokens", [True, False])
def test_a_plan_depends_on_every_observation(make_planner, batch, object_tokens, hidden_dim):
    policy, preprocessor, _ = make_planner(object_tokens=object_tokens, state_encoder_hidden_dim=hidden_dim)
    inputs = observation(preprocessor(batch))
    encoder = policy.planner.encoder
    for key, tensor in inputs.items():
        for component in range(tensor.shape[1]):
            changed = {**inputs, key: tensor.clone()}
            changed[key][:, component] += 0.5
            assert not torch.equal(encoder(changed), encoder(inputs))


def test_what_lerobot_stores_as_numbers_is_read_as_columns():
    """Features of shape (1,) are: of a batch it makes (B,)."""
    encoder = StateEncoder(["observation.state", "observation.gripper"], [3, 1], width=8, weight_std=0.5)
    batch = {"observation.state": torch.rand(5, 3), "observation.gripper": torch.rand(5, 1)}
    numbers = {**batch, "observation.gripper": batch["observation.gripper"][:, 0]}
    assert torch.equal(encoder(numbers), encoder(batch))
    step = SymbolicPlanProcessorStep(symbolic_horizon=1, vocabulary_size=3)
    assert step.observation({OBS_SYMBOLIC_PLAN: torch.tensor([2, 1, 2])})[OBS_SYMBOLIC_PLAN].shape == (3, 1)


@pytest.mark.parametrize(("hidden_dim", "is_linear"), [(0, True), (16, False)])
def test_a_state_encoder_with_hidden_units_is_not_linear(make_planner, batch, hidden_dim, is_linear):
    policy, preprocessor, _ = make_planner(state_encoder_hidden_dim=hidden_dim)
    near = observation(preprocessor(batch))
    far, between = ({key: tensor + shift for key, tensor in near.items()} for shift in (1.0, 0.5))
    encode = policy.planner.encoder
    assert torch.allclose(encode(between), (encode(near) + encode(far)) / 2, atol=1e-5) == is_linear


def test_what_hardly_varies_in_the_dataset_is_not_blown_up(dataset, make_planner, batch, tmp_path, monkeypatch, caplog):
    """Neither in a new training, nor in one that goes on from a checkpoint, as `lerobot-train` makes its normaliser."""
    caplog.set_level("INFO")
    key = "observation.environment_state"
    raw = dataset.meta.stats[key]

    narrow = raw["max"].copy()
    narrow[0] = raw["min"][0] + 1e-6
    monkeypatch.setitem(dataset.meta.stats, key, {**raw, "max": narrow})
    policy, new, postprocessor = make_planner()
    assert caplog.text.count(f"{key}: components [0] vary by less than a tenth of the widest one's range") == 1
    assert dataset.meta.stats[key]["max"] is narrow  # for whatever else is trained on it
    for part in (policy, new, postprocessor):
        part.save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    config.pretrained_path = tmp_path
    make_policy(config, ds_meta=dataset.meta)
    resumed, _ = make_pre_post_processors(
        config, str(tmp_path), preprocessor_overrides={"normalizer_processor": {"stats": dataset.meta.stats}}
    )
    moved = {**batch, key: batch[key].clone()}
    moved[key][:, :2] += 1e-3
    for preprocessor in (new, resumed):
        change = preprocessor(moved)[key] - preprocessor(batch)[key]
        wide, widest = (raw["max"] - raw["min"])[1], (raw["max"] - raw["min"])[1:].max()
        torch.testing.assert_close(change[:, 1], torch.full((4,), 2e-3 / wide), rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(change[:, 0], torch.full((4,), 2e-3 / (0.1 * widest)), rtol=1e-3, atol=1e-5)


def test_an_observation_that_never_varies_is_not_blown_up(dataset, make_planner, batch, monkeypatch):
    key = "observation.state"
    constant = batch[key][0].numpy()
    monkeypatch.setitem(dataset.meta.stats, key, {**dataset.meta.stats[key], "min": constant, "max": constant})
    _, preprocessor, _ = make_planner()
    moved = {**batch, key: batch[key][:1].expand(4, -1) + 1e-3}
    torch.testing.assert_close(preprocessor(moved)[key], torch.full_like(batch[key], 1e-3), rtol=1e-3, atol=1e-6)


def test_what_cannot_be_normalised_is_refused(dataset, make_planner, monkeypatch):
    monkeypatch.delitem(dataset.meta.stats, "observation.state")
    with pytest.raises(ValueError, match=r"no statistics of observation.state.*recompute_stats"):
        make_planner()


def test_statistics_that_are_not_numbers_are_refused(dataset, make_planner, monkeypatch):
    key, broken = "observation.environment_state", np.array([1.0, np.nan, 1.0, 1.0])
    monkeypatch.setitem(dataset.meta.stats, key, {**dataset.meta.stats[key], "max": broken})
    with pytest.raises(ValueError, match=r"the max of observation.environment_state .* in components \[1\]"):
        make_planner()


@pytest.mark.parametrize("planner", ["hdp", "joint_diffuser"])
@pytest.mark.parametrize(("bound", "value"), [("min", -1), ("max", 8)])
def test_plans_that_hold_no_symbols_are_refused(dataset, make_planner, monkeypatch, planner, bound, value):
    plans = dataset.meta.stats["observation.symbolic_plan"]
    broken = {**plans, bound: np.full_like(plans[bound], value)}
    monkeypatch.setitem(dataset.meta.stats, "observation.symbolic_plan", broken)
    with pytest.raises(ValueError, match=r"token ids from -?\d to \d, but the symbols are 0 to 7"):
        make_planner(planner)
    make_planner("diffuser")


@pytest.mark.parametrize(("plan_from", "is_warned"), [("episode_start", True), ("any_frame", False)])
def test_velocities_that_would_be_held_are_warned_of(dataset, make_planner, monkeypatch, caplog, plan_from, is_warned):
    monkeypatch.setitem(dataset.meta.features["action"], "names", ["x.vel", "y.vel", "gripper.pos"])
    make_planner(plan_from=plan_from)
    assert ("The actions x.vel, y.vel are velocities" in caplog.text) == is_warned


def test_tokens_survive_from_the_dataset_to_the_model_and_back_to_words(make_planner, batch, dataset):
    policy, preprocessor, _ = make_planner()
    tokens = preprocessor(batch)["observation.symbolic_plan"]
    assert tokens.dtype == torch.int64
    words = [policy.vocabulary.decode(row) for row in tokens]
    for plan in words:
        assert len(plan) == 18
        assert plan[0::6] == ["PICK"] * 3
        assert plan[3::6] == ["PLACE"] * 3
        assert plan[5] == "AUX"
    assert torch.equal(policy.vocabulary.encode(words[0], 18), dataset[0]["observation.symbolic_plan"])


def test_loss_is_the_weighted_sum_of_its_logged_parts(make_planner, batch):
    policy, preprocessor, _ = make_planner(symbol_loss_weight=0.25)
    loss, parts = policy.train().forward(preprocessor(batch))
    assert loss.item() == pytest.approx(parts["motion_loss"] + 0.25 * parts["symbol_loss"], rel=1e-5)


@pytest.mark.parametrize("lead_share", [0.0, 1.0])
@pytest.mark.parametrize("planner", ["hdp", "separate_diffuser"])
def test_training_shows_symbols_that_lead_as_often_as_it_is_told(make_planner, batch, planner, lead_share):
    policy, preprocessor, _ = make_planner(planner, lead_share=lead_share)
    calls = calls_of_network(policy)
    for _ in range(5):
        policy.train().forward(preprocessor(batch))
    assert all((call["motion_level"] == 1).all() for call in calls) == bool(lead_share)
    assert min(call["symbol_level"].min() for call in calls) < 0.5


def test_each_token_of_a_plan_has_a_probability(make_planner, batch):
    policy, preprocessor, _ = make_planner()
    probabilities = policy.eval().plan(observation(preprocessor(batch))).token_probabilities
    assert probabilities.shape == (4, 18)
    assert ((probabilities > 0) & (probabilities <= 1)).all()


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "confidence"])
@pytest.mark.parametrize("num_inference_steps", [1, 4, 10])
def test_the_number_of_network_calls_is_the_users_choice(make_planner, batch, sampler, num_inference_steps):
    policy, preprocessor, _ = make_planner(sampler=sampler, num_inference_steps=num_inference_steps)
    calls = calls_of_network(policy)
    policy.eval().plan(observation(preprocessor(batch)))
    assert len(calls) == num_inference_steps


def motion_moves(policy, inputs, prompt=None):
    """Of each network call, whether it moves the motion."""
    motions = []
    policy.eval().plan(inputs, prompt, on_step=lambda _, state: motions.append(state.motion))
    return [not torch.equal(before, after) for before, after in pairwise(motions)]


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "confidence"])
@pytest.mark.parametrize("planner", ["hdp", "separate_diffuser"])
def test_symbols_lead_a_motion_that_is_pure_noise(make_planner, batch, planner, sampler):
    policy, preprocessor, _ = make_planner(planner, sampler=sampler, num_inference_steps=10, symbol_lead=0.3)
    calls = calls_of_network(policy)
    assert motion_moves(policy, observation(preprocessor(batch))) == [False] * 3 + [True] * 7
    assert [call["motion_level"].max() for call in calls[:4]] == [1] * 4
    assert calls[4]["motion_level"].max() < 1
    k_d = [call["symbol_level"].min() for call in calls]
    assert k_d[3] < k_d[0] == 1  # symbols have been denoised meanwhile


def test_symbols_that_have_something_to_follow_do_not_lead(make_planner, batch):
    policy, preprocessor, _ = make_planner(num_inference_steps=4, symbol_lead=0.5)
    inputs = preprocessor(batch)
    given = torch.zeros(inputs["action"].shape[:2], dtype=torch.bool)
    given[:, :3] = True
    part_of_motion = PlanPrompt(actions=inputs["action"], actions_given=given)
    all_symbols = PlanPrompt(token_ids=inputs["observation.symbolic_plan"])
    some_symbols = PlanPrompt(token_ids=encode_prompt("PICK _ S1 PLACE", policy.vocabulary, 18).expand(4, -1))
    no_motion = PlanPrompt(actions=inputs["action"], actions_given=torch.zeros_like(given))
    assert motion_moves(policy, observation(inputs), part_of_motion) == [True] * 4
    assert motion_moves(policy, observation(inputs), no_motion) == [False, False, True, True]
    assert motion_moves(policy, observation(inputs), all_symbols) == [True] * 4
    assert motion_moves(policy, observation(inputs), some_symbols) == [False, False, True, True]


@pytest.mark.parametrize("planner", ["diffuser", "joint_diffuser"])
def test_without_symbols_of_a_level_of_their_own_nothing_leads(make_planner, batch, planner):
    policy, preprocessor, _ = make_planner(planner, num_inference_steps=4, symbol_lead=0.5)
    assert motion_moves(policy, observation(preprocessor(batch))) == [True] * 4
    with pytest.raises(ParsingError, match="lead_share"):
        make_planner(planner, lead_share=0.3)


def test_given_symbols_stay_fixed_in_every_step(make_planner, batch):
    policy, preprocessor, _ = make_planner()
    token_ids = encode_prompt("PICK _ S1 PLACE", policy.vocabulary, 18).expand(4, -1)
    states = []
    prompt = PlanPrompt(token_ids=token_ids)
    plan = policy.eval().plan(observation(preprocessor(batch)), prompt, on_step=lambda _, state: states.append(state))
    given = token_ids >= 0
    assert len(states) == 11
    assert all(torch.equal(state.tokens[given], token_ids[given]) for state in states)
    assert (states[0].tokens[~given] == policy.symbol_process.mask_id).all()
    assert (plan.token_probabilities[given] == 1).all()


def test_with_all_symbols_given_the_denoiser_is_told_that_they_are_clean(make_planner, batch):
    policy, preprocessor, _ = make_planner(sampler="ddpm")
    inputs, calls = preprocessor(batch), calls_of_network(policy)
    tokens = inputs["observation.symbolic_plan"]
    plan = policy.eval().plan(observation(inputs), PlanPrompt(token_ids=tokens))
    assert torch.equal(plan.token_ids, tokens)
    assert all((call["symbol_level"] == 0).all() for call in calls)
    assert calls[0]["motion_level"].max() == 1


def test_with_the_motion_given_only_symbols_are_sampled(make_planner, batch):
    policy, preprocessor, _ = make_planner()
    inputs, calls = preprocessor(batch), calls_of_network(policy)
    plan = policy.eval().plan(observation(inputs), PlanPrompt(actions=inputs["action"]))
    assert torch.equal(plan.actions, inputs["action"])
    assert all((call["motion_level"] == 0).all() for call in calls)
    assert calls[0]["symbol_level"].max() == 1
    assert plan.token_ids.max() < len(policy.vocabulary)


def test_a_prompt_from_the_environment_is_followed(make_planner, batch):
    """LeRobot hands an environment's observation over as floats."""
    policy, preprocessor, _ = make_planner()
    prompt = torch.full((4, 18), float(FREE))
    prompt[:, 0] = policy.vocabulary.encode("PICK", 1)
    inputs = preprocessor({**observation(batch), "observation.symbolic_plan": prompt})
    plan = policy.eval().plan(inputs)
    assert [policy.vocabulary.symbols[i] for i in plan.token_ids[:, 0]] == ["PICK"] * 4


def test_a_smaller_n_action_steps_replans(make_planner, batch):
    policy, preprocessor, _ = make_planner(n_action_steps=5, plan_from="any_frame")
    inputs = observation(preprocessor(batch))
    assert policy.eval().predict_action_chunk(inputs).shape == (4, 5, 3)
    calls = calls_of_network(policy)
    for _ in range(11):
        policy.select_action(inputs)
    assert len(calls) == 3 * policy.config.num_train_timesteps


def test_the_last_action_of_a_whole_plan_is_held_with_a_warning(make_planner, batch):
    policy, preprocessor, _ = make_planner()
    inputs = observation(preprocessor(batch))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(2):
            policy.reset()
            actions = [policy.select_action(inputs) for _ in range(HORIZON)]
    assert not torch.equal(actions[-1], actions[-2])
    for _ in range(2):
        with pytest.warns(UserWarning, match="the plan of 19 actions has ended"):
            assert torch.equal(policy.select_action(inputs), actions[-1])


def test_any_frame_trains_on_what_remains(make_planner, dataset):
    policy, preprocessor, _ = make_planner(plan_from="any_frame")
    assert policy.config.drop_n_last_frames == 0
    item = dataset[7]
    assert torch.equal(item["action"][-7:], item["action"][-1].expand(7, -1))
    assert len(policy.vocabulary.decode(item["observation.symbolic_plan"])) == 12
    remaining = preprocessor(default_collate([dataset[frame] for frame in (0, 7, HORIZON - 1)]))
    history = train_in_process(policy, remaining, steps=60)
    for name in ("motion_loss", "symbol_loss"):
        assert sum(parts[name] for parts in history[-10:]) < 0.7 * sum(parts[name] for parts in history[:10])


def test_a_planner_that_sees_no_objects_says_so(dataset, caplog):
    chosen = {"observation.state": PolicyFeature(FeatureType.STATE, (3,))}
    config = HDPConfig(**TINY_PLANNER, input_features=chosen, device="cpu")
    config.set_dataset_feature_metadata(dataset.meta.features)
    assert config.observation_token_sizes == [3]
    assert "the planner does not see where the objects are" in caplog.text


@pytest.mark.parametrize(
    ("name", "size", "message"),
    [
        ("observation.state", 7, r"says that observation.state is \('STATE', 7\), in the dataset it is \('STATE', 3\)"),
        ("observation.environment_state", 4, "in the dataset it is .'ENV', 4"),
        ("observation.force", 3, "names observation.force, which the dataset does not have; it has observation\\."),
    ],
)
def test_chosen_observations_are_those_of_the_dataset(dataset, name, size, message):
    chosen = {name: PolicyFeature(FeatureType.STATE, (size,))}
    with pytest.raises(ValueError, match=message):
        make_policy(HDPConfig(**TINY_PLANNER, input_features=chosen, device="cpu"), ds_meta=dataset.meta)


def test_an_open_prompt_stays_open_where_it_is_filled(make_planner, batch):
    """An environment may know a shorter plan than the planner makes."""
    policy, preprocessor, _ = make_planner(symbolic_horizon=24)
    prompt = torch.full((4, 18), FREE)
    prompt[:, 0] = 3  # PICK
    inputs = preprocessor(observation(batch) | {OBS_SYMBOLIC_PLAN: prompt})
    assert (inputs[OBS_SYMBOLIC_PLAN][:, 1:] == FREE).all()
    assert not policy.read_prompt(inputs).not_pad[:, 1:].any()


@pytest.mark.parametrize("ema_max_decay", [0.9999, 0.5])
def test_planning_uses_the_moving_average_of_the_weights(make_planner, batch, ema_max_decay):
    policy, preprocessor, _ = make_planner(ema_max_decay=ema_max_decay)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    inputs = preprocessor(batch)
    name, weight = next(iter(policy.planner.named_parameters()))
    expected = weight.detach().clone()
    for update in range(5):
        policy.train().forward(inputs)[0].backward()
        optimizer.step()
        policy.update()
        decay = 0.0 if update == 0 else min(1 - (1 + update) ** -0.75, ema_max_decay)
        expected = decay * expected + (1 - decay) * weight.detach()
    torch.testing.assert_close(dict(policy.ema.module.named_parameters())[name].detach(), expected)
    plans = []
    for changed in (None, policy.planner, policy.ema.module):
        if changed is not None:
            torch.nn.init.ones_(changed.get_parameter(name))
        plan = policy.eval().plan(observation(inputs), generator=torch.Generator().manual_seed(0))
        plans.append(plan.actions)
    assert torch.equal(plans[1], plans[0])
    assert not torch.equal(plans[2], plans[0])


def test_a_planner_saved_without_averaged_weights_can_be_trained_on_with_some(make_planner, tmp_path):
    policy, *_ = make_planner(ema_max_decay=0.0)
    policy.save_pretrained(tmp_path)
    policy.config.ema_max_decay = 0.99
    loaded = HDPPolicy.from_pretrained(tmp_path, config=policy.config)
    assert loaded.ema.n_averaged == 0
    for name, weight in policy.planner.named_parameters():
        torch.testing.assert_close(loaded.ema.module.get_parameter(name), weight.detach())


def test_a_planner_with_averaged_weights_can_be_trained_on_without(make_planner, batch, tmp_path):
    policy, preprocessor, _ = make_planner()
    with torch.no_grad():
        policy.update()
        for weight in policy.planner.parameters():
            weight += 0.1
    policy.save_pretrained(tmp_path)
    policy.config.ema_max_decay = 0.0
    loaded = HDPPolicy.from_pretrained(tmp_path, config=policy.config)
    inputs = observation(preprocessor(batch))
    plans = [each.plan(inputs, generator=torch.Generator().manual_seed(0)) for each in (policy.eval(), loaded.eval())]
    assert torch.equal(plans[0].actions, plans[1].actions)


@pytest.mark.parametrize("ema_max_decay", [0.9999, 0.0])
def test_a_loop_without_updates_of_the_average_plans_with_what_it_has_trained(
    make_planner, batch, tmp_path, ema_max_decay
):
    """As a loop of one's own, which need not know of `update`; loaded again with and without an average."""
    policy, preprocessor, _ = make_planner()
    inputs = preprocessor(batch)
    before = policy.eval().forward(inputs)[0]
    train_in_process(policy, inputs, steps=30)
    policy.save_pretrained(tmp_path)
    policy.config.ema_max_decay = ema_max_decay
    loaded = HDPPolicy.from_pretrained(tmp_path, config=policy.config)
    for each in (policy, loaded):
        assert each.eval().forward(inputs)[0] < 0.8 * before


def test_settings_are_not_given_to_from_pretrained_by_name(make_planner, tmp_path):
    make_planner()[0].save_pretrained(tmp_path)
    with pytest.raises(TypeError, match=r"cli_overrides=\['--num_inference_steps=3'\]"):
        HDPPolicy.from_pretrained(tmp_path, num_inference_steps=3)
    policy = HDPPolicy.from_pretrained(tmp_path, cli_overrides=["--num_inference_steps=3"])
    assert policy.config.num_inference_steps == 3


def test_the_plan_in_execution_can_be_read_and_prompted(make_planner, batch, caplog):
    policy, preprocessor, _ = make_planner()
    inputs = {key: value[:1] for key, value in observation(preprocessor(batch)).items()}
    assert policy.last_plan is None
    with caplog.at_level("INFO"):
        action = policy.select_action(inputs, prompt="PICK B ...")
    assert torch.equal(action, policy.last_plan.actions[:, 0])
    words = policy.last_plan.symbols()
    assert words[:2] == ["PICK", "B"]
    assert f"The plan: {' '.join(words)}" in caplog.text
    policy.reset()
    assert policy.last_plan is None


def test_a_plan_is_not_executed_in_other_environments(make_planner, batch):
    policy, preprocessor, _ = make_planner()
    inputs = observation(preprocessor(batch))
    policy.select_action(inputs)
    fewer = {key: value[:3] for key, value in inputs.items()}
    with pytest.raises(ValueError, match=r"a plan for 4 environments .* here are 3 observations: call reset"):
        policy.select_action(fewer)
    policy.reset()
    assert policy.select_action(fewer).shape == (3, 3)


def test_the_names_of_the_actions_travel_with_the_planner(make_planner, dataset, tmp_path):
    """`lerobot-rollout` puts a robot's joints into their order."""
    policy, *_ = make_planner()
    policy.save_pretrained(tmp_path)
    loaded = HDPPolicy.from_pretrained(tmp_path)
    assert loaded.config.action_feature_names == dataset.meta.features["action"]["names"]


def test_adapters_are_refused(make_planner):
    with pytest.raises(ValueError, match="leave out --peft"):
        make_planner()[0].wrap_with_peft(peft_cli_overrides={"r": 4})


def test_a_held_out_loss_depends_on_nothing_but_weights_and_data(make_planner, batch):
    policy, preprocessor, _ = make_planner()
    inputs = preprocessor(batch)
    losses = [policy.eval().forward(inputs)[0].item() for _ in range(2)]
    assert losses[0] == losses[1]
    torch.nn.init.zeros_(policy.planner.denoiser.motion_head.weight)
    policy.update()
    assert policy.forward(inputs)[0].item() != losses[0]


def test_the_noise_of_a_training_step_does_not_depend_on_the_global_generator(make_planner, batch):
    """LeRobot's data loader draws from it at every epoch, which a resumed run does at other steps."""
    losses = []
    for draws in (0, 3):
        policy, preprocessor, _ = make_planner(dropout=0.5)
        torch.rand(draws)
        losses.append([policy.train().forward(preprocessor(batch))[0].item() for _ in range(3)])
    assert losses[0] == losses[1]
    assert len(set(losses[0])) == 3


def test_a_policy_goes_on_from_the_state_that_it_loads(make_planner, batch):
    """With the noise and the averaging of the next step, wherever it was itself."""
    (ahead, preprocessor, _), (behind, *_) = make_planner(), make_planner()
    inputs = preprocessor(batch)
    for policy, steps in ((ahead, 3), (behind, 1)):
        for _ in range(steps):
            policy.train().forward(inputs)
            policy.update()
    behind.load_state_dict(ahead.state_dict())
    assert behind.forward(inputs)[0].item() == ahead.forward(inputs)[0].item()
    for policy in (ahead, behind):
        torch.nn.init.ones_(next(policy.planner.parameters()))
        policy.update()
    assert all(torch.equal(value, ahead.state_dict()[name]) for name, value in behind.state_dict().items())


def test_training_hides_where_the_objects_are_while_the_motion_does_too(make_planner, training_batch, dataset):
    """The noise of poses has the size that was asked for, in metres, and is none in evaluation."""
    policy, preprocessor, _ = make_planner(observation_noise=0.02)
    inputs, seen = preprocessor(training_batch(policy)), []
    policy.planner.encoder.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    stats = dataset.meta.stats[OBS_ENV_STATE]
    half_range = torch.tensor(stats["max"] - stats["min"]) / 2
    for level, expected in ((1.0, 0.02), (0.1, 0.0)):
        policy.motion_process.sample_level = lambda size, device, generator, level=level: torch.full((size,), level)
        seen.clear()
        for _ in range(100):
            policy.train().forward(inputs)
        shift = torch.stack([batch[OBS_ENV_STATE] - inputs[OBS_ENV_STATE] for batch in seen]) * half_range
        assert shift.std(dim=(0, 1)).tolist() == pytest.approx([expected] * 4, rel=0.2, abs=1e-4)
        assert all(torch.equal(batch["observation.state"], inputs["observation.state"]) for batch in seen)
    policy.update()
    policy.ema.module.encoder.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    policy.eval().forward(inputs)
    assert torch.equal(seen[-1][OBS_ENV_STATE], inputs[OBS_ENV_STATE])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observation_noise": -1.0}, "must be at least 0"),
        ({"policy_type": "hd", "observation_noise": 0.02}, "not for planners of type hd"),
        ({"observation_noise": 0.02, "normalization_mapping": {"ACTION": NormalizationMode.MIN_MAX}}, "ENV: MIN_MAX"),
    ],
)
def test_noise_of_poses_that_cannot_be_is_refused(make_planner, options, message):
    with pytest.raises(ParsingError, match=message):
        make_planner(**options)


def test_a_cpu_without_bfloat16_computes_in_float32_with_a_warning(monkeypatch):
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    with pytest.warns(UserWarning, match="no bfloat16 instructions") as warned:
        assert HDPConfig(dtype="bfloat16", device="cpu").dtype == "float32"
    assert warned[0].filename == __file__


@pytest.mark.parametrize("trains", [True, False])
def test_attention_is_pytorchs_in_training_with_bfloat16_too(trains):
    plain = torch.nn.TransformerDecoderLayer(32, 4, 64, 0.0, batch_first=True, norm_first=True)
    layer = DecoderLayer(None, 32, 4, 64, 0.0, batch_first=True, norm_first=True)
    layer.load_state_dict(plain.state_dict())
    tokens, memory = torch.randn(2, 5, 32, requires_grad=True), torch.randn(2, 3, 32)
    expected = plain(tokens, memory)
    [gradient] = torch.autograd.grad(expected.square().sum(), tokens)
    with torch.set_grad_enabled(trains):
        torch.testing.assert_close(layer(tokens, memory), expected)
        with torch.autocast("cpu", torch.bfloat16):
            found = layer(tokens, memory).float()
        torch.testing.assert_close(found, expected, atol=0.05, rtol=0.05)
    if trains:
        [found_gradient] = torch.autograd.grad(found.square().sum(), tokens)
        assert (found_gradient - gradient).norm() < 0.05 * gradient.norm()


def test_rotary_attention_is_plain_attention_that_knows_distances():
    plain = torch.nn.TransformerDecoderLayer(32, 4, 64, 0.0, batch_first=True, norm_first=True)
    tokens, memory = torch.randn(2, 5, 32), torch.randn(2, 3, 32)

    def rotary(positions):
        layer = DecoderLayer(torch.tensor(positions), 32, 4, 64, 0.0, batch_first=True, norm_first=True)
        layer.load_state_dict(plain.state_dict())
        return layer(tokens, memory)

    torch.testing.assert_close(rotary([0.0] * 5), plain(tokens, memory))
    torch.testing.assert_close(rotary([0.0, 1, 2, 5, 9]), rotary([3.0, 4, 5, 8, 12]), atol=1e-4, rtol=1e-4)
    assert not torch.allclose(rotary([0.0, 1, 2, 5, 9]), rotary([0.0, 1, 2, 5, 6]), atol=1e-4)


@pytest.mark.parametrize("policy_type", ["hdp", "joint_diffuser"])
def test_rotary_embedding_can_be_switched_off(make_planner, batch, policy_type):
    plans = []
    for rotary in (True, False):  # it has no weights
        policy, preprocessor, _ = make_planner(policy_type, rotary=rotary)
        policy.load_state_dict(make_planner(policy_type)[0].state_dict())
        inputs = observation(preprocessor(batch))
        plans.append(policy.eval().plan(inputs, generator=torch.Generator().manual_seed(0)).actions)
    assert plans[0].shape == (4, HORIZON, 3)
    assert not torch.equal(*plans)


def test_compilation_changes_neither_the_plan_nor_the_checkpoint(make_planner, batch):
    plans = []
    for compile_model in (False, True):
        policy, preprocessor, _ = make_planner(compile_model=compile_model, num_inference_steps=1)
        assert (policy.planner.denoiser._compiled_call_impl is not None) == compile_model
        assert not any("_orig_mod" in key for key in policy.state_dict())
        inputs = observation(preprocessor(batch))
        plans.append(policy.eval().plan(inputs, generator=torch.Generator().manual_seed(0)))
    torch.testing.assert_close(plans[0].actions, plans[1].actions, atol=1e-4, rtol=0)


class TestPaperPreset:
    def test_has_the_papers_values(self):
        config = HDPConfig(preset="paper", horizon=145, device="cpu")
        assert (config.num_layers, config.num_heads, config.width, config.dropout) == (8, 4, 256, 0.3)
        assert (config.rotary, config.object_tokens, config.observation_weight_std) == (False, False, 0.02)
        assert (config.prediction_type, config.num_train_timesteps) == ("epsilon", 100)
        assert (config.symbol_loss_weight, config.optimizer_type) == (1 / 30, "adamw")
        assert (config.sampler, config.symbol_lead, config.num_inference_steps) == ("ddpm", 0, 100)
        optimizer, scheduler = config.get_optimizer_preset(), config.get_scheduler_preset()
        assert (optimizer.lr, optimizer.betas, optimizer.weight_decay) == (1e-4, (0.9, 0.95), 1e-3)
        assert scheduler.num_warmup_steps == 1000

    def test_explicit_values_win(self):
        assert HDPConfig(preset="paper", dropout=0.1, device="cpu").dropout == 0.1

    def test_plans_are_filled_with_pad(self, make_planner, batch):
        policy, preprocessor, _ = make_planner(preset="paper", symbolic_horizon=108)
        tokens = preprocessor(batch)["observation.symbolic_plan"]
        assert tokens.shape == (4, 108)
        assert (tokens[:, 18:] == 0).all()
        assert policy.eval().plan(observation(preprocessor(batch))).token_ids.shape == (4, 108)


class TestBadInput:
    def test_a_token_id_without_a_symbol(self, make_planner, batch):
        _, preprocessor, _ = make_planner()
        batch["observation.symbolic_plan"][0, 0] = 8
        with pytest.raises(ValueError, match="token id 8, which is none of the 8 symbols"):
            preprocessor(batch)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda state: {}, "was trained on observation.environment_state, which is not observed here"),
            (
                lambda state: {"observation.environment_state": state[:, :3]},
                r"was trained on observation.environment_state of shape \[\d+\], here it has \[3\]",
            ),
            (lambda state: {"observation.environment_state": state.numpy()}, "is a ndarray: make it a torch.Tensor"),
        ],
    )
    def test_observations_of_another_task(self, make_planner, batch, change, message):
        _, preprocessor, _ = make_planner()
        state = batch.pop("observation.environment_state")
        with pytest.raises(ValueError, match=message):
            preprocessor({**batch, **change(state)})

    @pytest.mark.parametrize(
        ("plan", "message"),
        [
            (torch.zeros(2, 0, dtype=torch.int64), "a plan has 1 to 5 tokens, got 0"),
            (torch.zeros(2, 6, dtype=torch.int64), "a plan has 1 to 5 tokens, got 6"),
        ],
    )
    def test_a_plan_that_is_none(self, plan, message):
        step = SymbolicPlanProcessorStep(symbolic_horizon=5, vocabulary_size=3)
        with pytest.raises(ValueError, match=message):
            step.observation({OBS_SYMBOLIC_PLAN: plan})

    def test_token_ids_on_a_device_are_not_read(self):
        """The host would wait for them. A meta tensor has nothing to read."""
        step = SymbolicPlanProcessorStep(symbolic_horizon=5, vocabulary_size=3)
        plan = step.observation({OBS_SYMBOLIC_PLAN: torch.zeros(2, 4, dtype=torch.int64, device="meta")})
        assert plan[OBS_SYMBOLIC_PLAN].shape == (2, 5)

    def test_training_samples_from_the_middle_of_an_episode(self, make_planner, dataset):
        """As `--dataset.streaming=true` gives them, whatever `drop_n_last_frames` says."""
        middle = default_collate([dataset[0], dataset[1]])
        policy, preprocessor, _ = make_planner()
        with pytest.raises(ValueError, match=r"--dataset\.streaming=false"):
            policy.train().forward(preprocessor(middle))
        policy, preprocessor, _ = make_planner(plan_from="any_frame")
        assert policy.train().forward(preprocessor(middle))[0].isfinite()

    def test_settings_that_do_not_fit_the_weights(self, make_planner, tmp_path):
        policy, *_ = make_planner()
        policy.save_pretrained(tmp_path)
        policy.config.num_layers += 1
        with pytest.raises(ValueError, match=r"the settings do not fit the weights in .*decoder\.layers\.1"):
            HDPPolicy.from_pretrained(tmp_path, config=policy.config)

    @pytest.mark.parametrize(
        "override", ["prediction_type=epsilon", "rotary=false", "num_heads=4", "num_train_timesteps=20"]
    )
    def test_settings_that_give_the_weights_another_meaning(self, make_planner, tmp_path, override):
        make_planner()[0].save_pretrained(tmp_path)
        with pytest.raises(ValueError, match=rf"(?i){override} does not fit the weights in .* learned with"):
            HDPPolicy.from_pretrained(tmp_path, cli_overrides=[f"--{override}"])

    @pytest.mark.parametrize("horizon", [18, 20])
    def test_a_horizon_that_is_not_the_episodes(self, make_planner, horizon):
        message = f"up to 19 frames, the planner's horizon is {horizon}: set --policy.horizon=19.* leaves out count"
        with pytest.raises(ValueError, match=message):
            make_planner(horizon=horizon)

    def test_fine_tuning_on_longer_episodes_than_its_plans(self, make_planner, dataset, tmp_path):
        policy, *_ = make_planner()
        policy.config.horizon, policy.config.pretrained_path = 18, tmp_path
        with pytest.raises(ValueError, match="horizon is 18: the checkpoint's plans cannot hold them"):
            HDPPolicy(policy.config, dataset_meta=dataset.meta)

    def test_observations_on_another_device(self, make_planner, batch):
        policy, preprocessor, _ = make_planner()
        elsewhere = {key: value.to("meta") for key, value in observation(preprocessor(batch)).items()}
        with pytest.raises(
            ValueError, match=r"is on meta, the planner on cpu: make the preprocessor with preprocessor_"
        ):
            policy.plan(elsewhere)

    def test_a_prompt_of_another_kind(self, make_planner, batch):
        policy, preprocessor, _ = make_planner()
        inputs = observation(preprocessor(batch))
        for prompt in (["PICK A", None, "", ""], torch.zeros(4, 18)):
            with pytest.raises(TypeError, match="a prompt is a string, a list of one for each observation, or a Plan"):
                policy.plan(inputs, prompt)

    def test_an_observation_that_is_missing(self, make_planner, batch):
        policy, preprocessor, _ = make_planner()
        inputs = observation(preprocessor(batch))
        del inputs["observation.environment_state"]
        with pytest.raises(ValueError, match=r"trained on observation[.]environment_state, which is not observed"):
            policy.eval().select_action(inputs)

    def test_no_horizon(self):
        with pytest.raises(ValueError, match=r"--policy.horizon is missing"):
            _ = HDPConfig(device="cpu").action_delta_indices

    def test_a_dataset_without_symbols(self, dataset):
        config = HDPConfig(**TINY_PLANNER, device="cpu")
        features = {k: v for k, v in dataset.meta.features.items() if k != "observation.symbolic_plan"}
        with pytest.raises(ValueError, match=r"--policy.type=diffuser"):
            config.set_dataset_feature_metadata(features)

    def test_another_vocabulary_than_the_checkpoints(self, dataset):
        config = HDPConfig(**TINY_PLANNER, vocabulary=["PAD", "X", "Y"], device="cpu")
        with pytest.raises(ValueError, match="is not the checkpoint's PAD X Y"):
            make_policy(config, ds_meta=dataset.meta)

    def test_plans_longer_than_the_symbolic_horizon(self, make_planner):
        with pytest.raises(ValueError, match="symbolic_horizon=12 is shorter than the dataset's plans of 18"):
            make_planner(symbolic_horizon=12)

    @pytest.mark.parametrize("damage", ["truncated", "missing"])
    def test_a_damaged_checkpoint(self, make_planner, tmp_path, damage):
        policy, *_ = make_planner()
        policy.save_pretrained(tmp_path)
        weights = tmp_path / "model.safetensors"
        if damage == "truncated":
            weights.write_bytes(weights.read_bytes()[:1000])
            with pytest.raises(ValueError, match="damaged or incomplete"):
                HDPPolicy.from_pretrained(tmp_path)
        else:
            weights.unlink()
            with pytest.raises(FileNotFoundError, match="missing from the checkpoint"):
                HDPPolicy.from_pretrained(tmp_path)

    @pytest.mark.parametrize(
        "field",
        [
            {"preset": "best"},
            {"prediction_type": "noise"},
            {"sampler": "euler"},
            {"plan_from": "middle"},
            {"dtype": "float8"},
            {"use_amp": True},
            {"n_obs_steps": 2},
            {"width": 30, "num_heads": 4},
            {"width": 2, "num_heads": 1},
            {"rotary": True, "width": 6, "num_heads": 2},
            {"horizon": 0},
            {"horizon": 10, "n_action_steps": 11},
            {"n_action_steps": 5, "horizon": 10},  # with plan_from=episode_start
            {"num_layers": 0},
            {"num_heads": 0},
            {"dropout": 1.5},
            {"confidence_threshold": -1.0},
            {"symbol_lead": 1.0},
            {"symbol_lead": -0.1},
            {"lead_share": 1.5},
            {"mask_schedule": "sine"},
            {"optimizer_type": "sgd"},
            {"normalization_mapping": {"ACTION": NormalizationMode.MEAN_STD}},
            {"num_inference_steps": 101},
            {"num_candidates": 0},
            {"state_encoder_hidden_dim": -1},
        ],
    )
    def test_impossible_settings(self, field):
        with pytest.raises(ParsingError, match=next(iter(field))):
            HDPConfig(**field, device="cpu")
