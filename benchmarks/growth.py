"""How the time of a training step and of a plan grows with the horizon and with the number of blocks.

    python -m benchmarks.growth             # measures, then writes docs/growth.md
    python -m benchmarks.growth --report    # only writes the page

HDP, Diffuser (`diffuser`, the motion alone) and LeRobot's own diffusion policy (`diffusion`, a U-Net; needs
`lerobot[diffusion]`), with random weights, one observation and the same number of network calls, measured in turns. The
U-Net's horizon is the next multiple of 8. A ratio is over `diffuser` in the same turn; times and ratios are [first
quartile, median, third quartile]. Over the horizon, HDP has as many symbols as the task with that density has, 36; over
the blocks, horizon and symbols grow together.
"""

import argparse
import json
from collections.abc import Callable
from typing import Any

import torch
from lerobot.configs import PolicyFeature
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from gym_hdp_tasks.env_config import HDPEnv
from lerobot_hdp.configuration_hdp import OBS_SYMBOLIC_PLAN

from .machine import RESULTS, describe_run, write_json
from .pages import DOCS, LABELS, markdown_table
from .planner_latency import make_planner
from .timing import compare

FILE, PAGE = RESULTS / "growth.json", DOCS / "growth.md"
HORIZONS = (37, 73, 145, 289, 577)
BLOCKS = (2, 3, 4, 6, 8)
REFERENCE = "diffuser"
NETWORK = {"num_layers": 4, "width": 128, "num_inference_steps": 10}


def make_diffusion(horizon: int, action: PolicyFeature, inputs: dict[str, PolicyFeature]) -> DiffusionPolicy:
    """LeRobot's diffusion policy as an open-loop planner, of about the size of the others."""
    horizon = -(-horizon // 8) * 8
    config = DiffusionConfig(
        n_obs_steps=1,
        horizon=horizon,
        n_action_steps=horizon,
        down_dims=(64, 96, 128),
        noise_scheduler_type="DDIM",
        num_inference_steps=NETWORK["num_inference_steps"],
        device="cpu",
    )
    config.input_features, config.output_features = inputs, {ACTION: action}
    return DiffusionPolicy(config)


def make_planners(env: HDPEnv, horizon: int) -> dict[str, PreTrainedPolicy]:
    planners: dict[str, PreTrainedPolicy] = {
        name: make_planner(name, env, horizon=horizon, device="cpu", **NETWORK) for name in ("diffuser", "hdp")
    }
    config = planners["hdp"].config
    planners["diffusion"] = make_diffusion(horizon, config.action_feature, config.input_features)
    return planners


def make_batch(policy: PreTrainedPolicy, batch_size: int) -> dict[str, Tensor]:
    """Random normalised data, as the policy's preprocessor makes them."""
    config = policy.config
    sizes = {key: feature.shape[0] for key, feature in config.input_features.items()}
    batch = {key: torch.rand(batch_size, size) * 2 - 1 for key, size in sizes.items()}
    batch[ACTION] = torch.rand(batch_size, config.horizon, config.action_feature.shape[0]) * 2 - 1
    if isinstance(policy, DiffusionPolicy):
        batch |= {key: batch[key][:, None] for key in (OBS_STATE, OBS_ENV_STATE)}
        batch["action_is_pad"] = torch.zeros(batch_size, config.horizon, dtype=torch.bool)
    elif config.symbol_process:
        batch[OBS_SYMBOLIC_PLAN] = torch.randint(len(config.vocabulary), (batch_size, config.symbolic_horizon))
    return batch


def train_step(policy: PreTrainedPolicy, batch: dict[str, Tensor]) -> None:
    """Forward and backward pass, without the optimiser, which does not depend on the horizon."""
    policy.train()
    policy.forward(batch)[0].backward()
    policy.zero_grad()


@torch.no_grad()
def make_plan(policy: PreTrainedPolicy, batch: dict[str, Tensor]) -> None:
    policy.eval()
    if isinstance(policy, DiffusionPolicy):
        policy.diffusion.generate_actions(batch)
    else:
        policy.plan({key: batch[key] for key in policy.config.input_features})


def measure(env: HDPEnv, horizon: int, batch_size: int, rounds: int) -> dict[str, Any]:
    planners = make_planners(env, horizon)
    batches = {name: make_batch(policy, batch_size) for name, policy in planners.items()}
    single = {name: make_batch(policy, 1) for name, policy in planners.items()}

    def actions(function: Callable, inputs: dict[str, dict[str, Tensor]]) -> dict[str, Callable[[], None]]:
        return {name: lambda name=name: function(planners[name], inputs[name]) for name in planners}

    return {
        "horizon": horizon,
        "symbolic_horizon": planners["hdp"].config.symbolic_horizon,
        "parameters": {
            name: sum(p.numel() for p in policy.parameters() if p.requires_grad) for name, policy in planners.items()
        },
        "train_step": compare(actions(train_step, batches), rounds, REFERENCE),
        "plan": compare(actions(make_plan, single), rounds, REFERENCE),
    }


def write_page() -> None:
    """The results file as two tables."""
    file = json.loads(FILE.read_text())
    run, result = file["run"], file["result"]
    names = {name: LABELS.get(name, "LeRobot's diffusion policy") for name in ("diffuser", "hdp", "diffusion")}
    header = [f"{what}, {name}" for what in ("training step", "plan") for name in names.values()]

    def cells(measured: dict[str, Any]) -> list[str]:
        row = []
        for column in ("train_step", "plan"):
            for name in names:
                milliseconds, ratios = measured[column][name]["ms"][1], measured[column][name]["ratio"]
                spread = "" if name == REFERENCE else f", {ratios[1]:.2f} ({ratios[0]:.2f} to {ratios[2]:.2f})"
                row.append(f"{milliseconds:.0f} ms{spread}")
        return row

    def table(label: str, key: str, rows: list[dict[str, Any]]) -> str:
        content = [[str(row[key]), f"{row['horizon']} + {row['symbolic_horizon']}", *cells(row)] for row in rows]
        return markdown_table([label, "actions + tokens", *header], content)

    over_horizon, over_blocks = result["over_horizon"], result["over_blocks"]
    parameters = over_horizon[0]["parameters"]
    sizes = ", ".join(f"{names[name]} {parameters[name]:,}" for name in names)
    PAGE.write_text(
        "# How time grows with the horizon and with the number of blocks\n\n"
        f"A training step is the forward and backward pass of a batch of {result['batch_size']}; a plan is made alone, "
        f"with {result['num_inference_steps']} network calls. {result['num_layers']} layers of width "
        f"{result['width']}; parameters at the first horizon: {sizes}. LeRobot's diffusion policy is a U-Net. Median "
        "times, and the ratio to Diffuser's in the same turn (median and quartiles). "
        f"{result['threads']} thread of {run['cores']} cores, {run['cpu']}. `{run['command']}`, code of "
        f"{run['git_commit']}.\n\n"
        "## Over the horizon\n\nThree blocks, more and more waypoints for the same plan.\n\n"
        f"{table('actions', 'horizon', over_horizon)}\n"
        "## Over the number of blocks\n\nOne waypoint a pose; horizon and symbols grow together.\n\n"
        f"{table('blocks', 'n_blocks', over_blocks)}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--horizons", type=int, nargs="*", default=HORIZONS)
    parser.add_argument("--blocks", type=int, nargs="*", default=BLOCKS)
    parser.add_argument("--batch_size", type=int, default=16, help="of a training step; a plan is made alone")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    if options.report:
        write_page()
        return
    torch.set_num_threads(options.threads)
    run = describe_run()
    result: dict[str, Any] = {**NETWORK, "batch_size": options.batch_size, "threads": options.threads}
    result["over_horizon"], result["over_blocks"] = [], []
    for horizon in options.horizons:
        result["over_horizon"].append(measure(HDPEnv(n_blocks=3), horizon, options.batch_size, options.rounds))
        print(json.dumps(result["over_horizon"][-1]), flush=True)
    for n_blocks in options.blocks:
        env = HDPEnv(n_blocks=n_blocks, waypoints_per_pose=1)
        measured = measure(env, env.planning_task.horizon, options.batch_size, options.rounds)
        result["over_blocks"].append({"n_blocks": n_blocks, **measured})
        print(json.dumps(result["over_blocks"][-1]), flush=True)
    write_json(FILE, {"run": run, "result": result})
    write_page()


if __name__ == "__main__":
    main()
