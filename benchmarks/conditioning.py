"""What planners do with a part of the plan given, and with a choice among several plans.

    python -m benchmarks.conditioning adherence --checkpoints HDP JOINT SEPARATE
    python -m benchmarks.conditioning valid_plan --checkpoints TWO_BLOCKS THREE_BLOCKS FOUR_BLOCKS
    python -m benchmarks.conditioning candidates --checkpoints THREE_BLOCKS FOUR_BLOCKS

Checkpoints are `pretrained_model` folders; each plans for the task that its training configuration names, from the same
starts. `adherence` takes planners of one task: BlockSorting2D, in which the prompt says which block is moved first, or
XArmToolUse, in which it says that red is stacked last (the paper's "conditional plan coherence"). Each writes
`benchmarks/results/<command>_<task>.json`.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.train import TrainPipelineConfig

import lerobot_policy_hdp  # noqa: F401 (registers the policies and the tasks)
from dataset_tools.demonstration import expert_generator
from dataset_tools.experts import EXPERTS
from gym_hdp_tasks.block_sorting_2d import SLOT_HALF_SIZE, block_name
from lerobot_hdp.candidates import best_candidates

from .evaluation import Subject, execute, load, make_plans, rate, wilson_interval
from .machine import RESULTS, describe_run, write_json
from .timing import timed

CANDIDATES = (1, 2, 4, 8)
TIMED_STARTS = 20


def adherence(checkpoints: Sequence[Path], starts: int, num_inference_steps: int | None) -> list[dict]:
    """Of the plans that succeed otherwise, how many do what the prompt asks for, with the prompt and without."""
    results = []
    for path in checkpoints:
        trained_on = TrainPipelineConfig.from_pretrained(path).env.planning_task.gym_id
        tool_use = trained_on == "hdp/XArmToolUse-v0"
        gym_id = "hdp/XArmToolUseRedOnTop-v0" if tool_use else None
        subject = load(path, starts, gym_id, num_inference_steps=num_inference_steps)
        if tool_use:
            prompts: Any = torch.tensor(np.stack([o["symbolic_plan"] for o in subject.observations]))
            asked, done, otherwise_good = ["RED"] * starts, "top_block", "all_stacked"
        else:
            asked = _movable_blocks(subject)
            prompts, done, otherwise_good = [f"PICK {block}" for block in asked], "first_block", "is_success"
        result = subject.facts()
        for name, given in (("with_prompt", prompts), ("without_prompt", None)):
            outcomes = execute(subject, make_plans(subject, given).motions, subject.seeds)
            pairs = [(o[done] == block) for o, block in zip(outcomes, asked, strict=True) if o[otherwise_good]]
            result[name] = {"adherence": rate(pairs), otherwise_good: rate([o[otherwise_good] for o in outcomes])}
        print(json.dumps(result), flush=True)
        results.append(result)
    return results


def _movable_blocks(subject: Subject) -> list[str]:
    """For each start a block that a demonstration might move first: any that is not in its own slot."""
    rng, env, asked = np.random.default_rng(0), subject.make_env(), []
    for seed in subject.seeds:
        env.reset(seed=seed)
        sim = env.unwrapped
        home = np.abs(sim.blocks - sim.slots[: sim.n_blocks]).max(axis=1) <= SLOT_HALF_SIZE
        asked.append(block_name(int(rng.choice(np.flatnonzero(~home)))))
    return asked


def valid_plan(checkpoints: Sequence[Path], starts: int, num_inference_steps: int | None) -> list[dict]:
    """Success with the expert's symbolic plan given, and with none."""
    results = []
    for path in checkpoints:
        subject = load(path, starts, num_inference_steps=num_inference_steps)
        env, plans = subject.make_env(), []
        for seed in subject.seeds:
            env.reset(seed=seed)
            symbols = EXPERTS[subject.gym_id](env, expert_generator(seed)).remaining_symbols(0)
            plans.append(subject.policy.vocabulary.encode(symbols, subject.policy.config.symbolic_horizon))
        result = subject.facts()
        for name, given in (("valid_plan_given", torch.stack(plans)), ("nothing_given", None)):
            outcomes = execute(subject, make_plans(subject, given).motions, subject.seeds)
            result[name] = {
                "success": rate([o["is_success"] for o in outcomes]),
                "mean_score": round(np.mean([o["score"] for o in outcomes]), 4),
            }
        print(json.dumps(result), flush=True)
        results.append(result)
    return results


@dataclass
class Candidates:
    """Several plans for each start: (starts, k) arrays.

    Attributes:
        success: whether the executed plan succeeded.
        scores: the model's score of the plan.
        complaints: how many the task's checker has about its symbols.
    """

    success: np.ndarray
    scores: torch.Tensor
    complaints: np.ndarray

    def best_of(self, k: int, checked: bool) -> dict[str, Any]:
        """Success of the best of k. All groups of k count, so that a small k rests on as many plans as a large one."""
        starts, most = self.success.shape
        hits = []
        for group in (slice(first, first + k) for first in range(0, most, k)):
            counts = self.complaints[:, group].tolist() if checked else None
            chosen = best_candidates(self.scores[:, group], counts).numpy()
            hits.append(self.success[:, group][np.arange(starts), chosen])
        mean = float(np.mean(hits))
        # Groups of one start are not independent: as many trials as there are starts.
        return {"rate": round(mean, 4), "interval_95": wilson_interval(round(mean * starts), starts)}


def draw_candidates(subject: Subject, number: int) -> Candidates:
    """Make, score, check and execute a number of plans for each start."""
    task = subject.make_env().unwrapped.planning_task
    success, scores, complaints = [], [], []
    torch.manual_seed(0)
    for i, seed in enumerate(subject.seeds):
        inputs = {key: value[i : i + 1].repeat_interleave(number, dim=0) for key, value in subject.inputs.items()}
        plan = subject.policy.plan(inputs, num_candidates=1)
        scores.append(subject.policy.score(inputs, plan).cpu())
        complaints.append([len(task.check_plan(plan.symbols(j), subject.observations[i])) for j in range(number)])
        outcomes = execute(subject, subject.postprocessor(plan.actions).numpy(), [seed] * number)
        success.append([outcome["is_success"] for outcome in outcomes])
    return Candidates(np.array(success), torch.stack(scores), np.array(complaints))


def seconds_per_plan(subject: Subject, k: int) -> float:
    """Median time to plan for one start with k candidates."""
    seconds = []
    for i in range(TIMED_STARTS):
        inputs = {key: value[i : i + 1] for key, value in subject.inputs.items()}
        seconds.append(timed(partial(subject.policy.plan, inputs, num_candidates=k)))
    return float(np.median(seconds))


def candidates(checkpoints: Sequence[Path], starts: int, num_inference_steps: int | None) -> list[dict]:
    """Success of the best of k plans, by the model's own likelihood, and by the task's checker before it."""
    results = []
    for path in checkpoints:
        subject = load(path, starts, num_inference_steps=num_inference_steps)
        drawn = draw_candidates(subject, max(CANDIDATES))
        best_of = [
            {
                "k": k,
                "by_likelihood": drawn.best_of(k, checked=False),
                "by_checker": drawn.best_of(k, checked=True),
                "seconds_per_plan": round(seconds_per_plan(subject, k), 4),
            }
            for k in CANDIDATES
        ]
        result = {
            **subject.facts(),
            "valid_symbolic_plans": round(float((drawn.complaints == 0).mean()), 4),
            "starts_that_any_candidate_solves": round(float(drawn.success.any(axis=1).mean()), 4),
            "best_of": best_of,
        }
        print(json.dumps(result), flush=True)
        results.append(result)
    return results


COMMANDS: dict[str, Callable[..., list[dict]]] = {
    "adherence": adherence,
    "valid_plan": valid_plan,
    "candidates": candidates,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=COMMANDS)
    parser.add_argument("--checkpoints", nargs="+", type=Path, required=True)
    parser.add_argument("--starts", type=int, default=200)
    parser.add_argument("--num_inference_steps", type=int, help="network calls for a plan; else as in the checkpoint")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    run_facts = describe_run()
    results = COMMANDS[options.command](options.checkpoints, options.starts, options.num_inference_steps)
    task = results[0]["task"].removesuffix("-v0")
    path = options.results / f"{options.command}_{task}.json"
    write_json(path, {"run": run_facts, "results": results})
    print(f"written: {path}")


if __name__ == "__main__":
    main()
