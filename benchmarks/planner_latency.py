"""How long each planner takes to make a plan, and how many parameters it has, side by side on one machine.

python -m benchmarks.planner_latency

Writes `benchmarks/results/planner_latency/DEVICE.json` and, from all of them, `docs/planner_latency.md`. Networks have
the paper's size and random weights. Every round times each planner once, in a new order, so that whatever else the
machine does falls on all of them; a ratio compares two times of the same round. A plan takes `--num_inference_steps`
network calls on each level of a planner, fewer than the paper's 100: the ratios depend little on their number.
"""

import argparse
import json
from functools import partial

import torch
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.policies.factory import get_policy_class
from lerobot.utils.feature_utils import dataset_to_policy_features

import lerobot_policy_hdp  # noqa: F401 (registers the planners)
from dataset_tools.record import RecordConfig, RecordDatasetConfig, dataset_features
from gym_hdp_tasks.env_config import HDPEnv
from lerobot_hdp.modeling_hdp import HDPPolicy

from .cells import num_parameters
from .machine import RESULTS, describe_run, write_json
from .pages import DOCS, markdown_table
from .paper.presets import ENVS, METHODS, PRESETS, make_cell, observes_images
from .timing import compare

FILES, PAGE = RESULTS / "planner_latency", DOCS / "planner_latency.md"
REFERENCE = "diffuser"
TASKS = [task for task in PRESETS["paper"].tasks if not observes_images(ENVS[task])]
"""Those that all six planners can do."""


def make_planner(policy_type: str, env: HDPEnv, **options) -> HDPPolicy:
    """A planner for a task, with random weights and without a dataset."""
    columns = dataset_features(RecordConfig(RecordDatasetConfig("local/none"), env))
    features = dataset_to_policy_features(columns)
    config = PreTrainedConfig.get_choice_class(policy_type)(**{"horizon": env.planning_task.horizon, **options})
    config.input_features = {k: f for k, f in features.items() if f.type in (FeatureType.STATE, FeatureType.ENV)}
    config.output_features = {k: f for k, f in features.items() if f.type is FeatureType.ACTION}
    config.set_dataset_feature_metadata(columns)
    return get_policy_class(policy_type)(config).to(config.device).eval()


def measure(planners: dict[str, HDPPolicy], batch_size: int, rounds: int) -> dict[str, dict[str, list[float]]]:
    """How long a batch of plans takes each planner, see `compare`."""
    policy = planners[REFERENCE]
    batch = {
        key: torch.rand(batch_size, *feature.shape, device=policy.config.device) * 2 - 1
        for key, feature in policy.config.input_features.items()
    }

    def plan(policy: HDPPolicy) -> None:
        policy.plan(batch).actions.sum().item()  # waits for an accelerator

    return compare({name: partial(plan, planner) for name, planner in planners.items()}, rounds, REFERENCE)


def read_results() -> list[dict]:
    """The contents of the results files, one for each device."""
    return [json.loads(path.read_text()) for path in sorted(FILES.glob("*.json"))]


def device_name(content: dict) -> str:
    """What a results file was measured on."""
    return content["run"]["cpu" if content["result"]["device"] == "cpu" else "gpu"]


def describe(content: dict) -> str:
    """One device's part of the page."""
    run, result = content["run"], content["result"]
    threads = f", {result['threads']} thread(s) of PyTorch" if result["device"] == "cpu" else ""
    sizes = result["batch_size"]
    header, rows = ["planner", "parameters", "over Diffuser"], []
    for size in sizes:
        header += [f"batch {size}, ms", "over Diffuser"]
    for name in (method for method in METHODS if method in result["parameters"]):
        cells = [f"`{name}`", f"{result['parameters'][name]:,}", f"{result['parameter_ratio'][name] - 1:+.1%}"]
        for measured in sizes.values():
            for low, middle, high in (measured[name]["ms"], measured[name]["ratio"]):
                cells.append(f"{middle:g} ({low:g} to {high:g})")
        rows.append(cells)
    return (
        f"## {device_name(content)}{threads}\n\n"
        f"For `{result['task']}`: {result['num_layers']} layers of width {result['width']}, "
        f"{result['num_inference_steps']} steps a plan. Median and quartiles of {result['rounds']} rounds.\n\n"
        f"{markdown_table(header, rows)}\n`{run['command']}`, code of {run['git_commit']}.\n"
    )


def write_page() -> None:
    """Write the page from the results files."""
    parts = [describe(content) for content in read_results()]
    about = "Networks of the paper's size, with random weights. A ratio compares two times of the same round."
    PAGE.write_text("\n".join(["# Size and latency of the planners\n", f"{about}\n", *parts]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=TASKS, default="xarm_sorting")
    parser.add_argument("--batch_sizes", type=int, nargs="+", default=[1, 50])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--num_inference_steps", type=int, default=5)
    parser.add_argument("--num_layers", type=int, default=8)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1, help="of PyTorch, on a CPU")
    options = parser.parse_args()

    torch.set_num_threads(options.threads)
    run = describe_run()
    env = HDPEnv(**ENVS[options.task])
    sizes = {name: getattr(options, name) for name in ("num_layers", "width", "num_inference_steps", "device")}
    planners = {}
    for name in METHODS:
        policy = make_cell("paper", options.task, name, seed=0).policy
        planners[name] = make_planner(policy.pop("type"), env, **{**policy, **sizes})

    parameters = {name: num_parameters(policy) for name, policy in planners.items()}
    result = {
        "task": env.gym_id,
        **sizes,
        "threads": options.threads,
        "rounds": options.rounds,
        "parameters": parameters,
        "parameter_ratio": {name: round(n / parameters[REFERENCE], 4) for name, n in parameters.items()},
        "batch_size": {size: measure(planners, size, options.rounds) for size in options.batch_sizes},
    }
    write_json(FILES / f"{options.device}.json", {"run": run, "result": result})
    write_page()
    print(PAGE.read_text())


if __name__ == "__main__":
    main()
