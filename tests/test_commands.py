"""LeRobot's own commands, and `hdp-plan`, run as a user runs them or, where that is not the point, called here."""

import json
import re
import shutil
import subprocess
import sys
from html import unescape
from pathlib import Path

import numpy as np
import pytest
import torch
from draccus.utils import ParsingError
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_tools import modify_features, recompute_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from lerobot.scripts import lerobot_edit_dataset, lerobot_eval, lerobot_train
from safetensors.torch import load_file

from gym_hdp_tasks.env_config import HDPEnv
from lerobot_hdp import HDPConfig, Vocabulary
from lerobot_hdp.scripts import hdp_plan, hdp_train

from .conftest import HORIZON, N_EPISODES, REPOSITORY, TASK_FLAGS, TINY_PLANNER, call_command, run_command

ENV_FLAGS = ("--env.type=hdp", *TASK_FLAGS)
CONFIGS = sorted((REPOSITORY / "configs").glob("*.json"))


def train_flags(dataset_root: Path, output_dir: Path, policy_flags=None) -> list[str]:
    if policy_flags is None:
        policy_flags = ["--policy.type=hdp", *(f"--policy.{name}={value}" for name, value in TINY_PLANNER.items())]
    return [
        "--dataset.repo_id=test/sorting",
        f"--dataset.root={dataset_root}",
        "--dataset.video_backend=pyav",
        f"--output_dir={output_dir}",
        *policy_flags,
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--batch_size=8",
        "--steps=4",
        "--num_workers=0",
        "--log_freq=4",
    ]


@pytest.fixture(scope="module")
def run(dataset_root, tmp_path_factory) -> tuple[str, Path]:
    """What `lerobot-train --policy.type=hdp` wrote to stderr, and its folder."""
    output_dir = tmp_path_factory.mktemp("runs") / "hdp"
    flags = train_flags(dataset_root, output_dir)
    return run_command("lerobot-train", *flags, *ENV_FLAGS, "--env_eval_freq=0").stderr, output_dir


@pytest.fixture(scope="module")
def checkpoint(run) -> Path:
    return run[1] / "checkpoints" / "last" / "pretrained_model"


def test_both_losses_are_logged_without_a_page_of_warnings(run):
    log, _ = run
    assert "motion_loss:" in log
    assert "symbol_loss:" in log
    noise = [line for line in log.splitlines() if "warning" in line.lower() or "Traceback" in line]
    assert len(noise) <= 3


def test_vocabulary_and_normalisation_travel_in_the_checkpoint(checkpoint, dataset_root):
    config = json.loads((checkpoint / "config.json").read_text())
    assert config["vocabulary"] == ["PAD", "A", "B", "PICK", "PLACE", "S1", "S2", "AUX"]
    assert config["symbolic_horizon"] == 18
    [statistics] = checkpoint.glob("policy_preprocessor*.safetensors")
    recorded = json.loads((dataset_root / "meta/stats.json").read_text())["action"]["max"]
    torch.testing.assert_close(load_file(statistics)["action.max"], torch.tensor(recorded))


def test_lerobot_eval_scores_the_policy(checkpoint, tmp_path):
    run_command(
        "lerobot-eval",
        f"--policy.path={checkpoint}",
        "--policy.prompt=... PICK A _ PLACE _ _",
        *ENV_FLAGS,
        "--eval.n_episodes=4",
        "--eval.batch_size=2",
        f"--output_dir={tmp_path}",
    )
    overall = json.loads((tmp_path / "eval_info.json").read_text())["overall"]
    assert overall["n_episodes"] == 4
    assert overall["pc_success"] == 0  # of a planner that is as good as untrained
    assert len(overall["video_paths"]) == 4
    assert all(Path(path).stat().st_size > 1000 for path in overall["video_paths"])


def test_a_success_is_reported_as_one(tmp_path, capsys):
    planner = f"--policy.path={REPOSITORY / 'checkpoints/xarm_arrange_blocks'}"
    flags = ("--env.type=hdp", "--env.task=XArmArrangeBlocks-v0", f"--output_dir={tmp_path}")
    flags += ("--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=false")
    call_command(lerobot_eval.main, planner, *flags)
    assert json.loads((tmp_path / "eval_info.json").read_text())["overall"]["pc_success"] == 100
    capsys.readouterr()
    call_command(hdp_plan.main, planner, f"--output_dir={tmp_path / 'plan'}")
    printed = capsys.readouterr().out
    assert "checked: valid\n" in printed
    assert "executed: score 1.00, success\n" in printed


def test_lerobot_eval_reads_the_prompt(checkpoint, tmp_path):
    flags = (f"--policy.path={checkpoint}", "--policy.prompt=PICK D", *ENV_FLAGS, f"--output_dir={tmp_path}")
    with pytest.raises(ParsingError, match=r"unknown symbol 'D' \(word 2 of the prompt\)"):
        call_command(lerobot_eval.main, *flags)


def test_a_checkpoint_can_be_fine_tuned(dataset_root, checkpoint, tmp_path):
    flags = train_flags(dataset_root, tmp_path / "tuned", [f"--policy.path={checkpoint}"])
    call_command(lerobot_train.main, *flags)
    tuned = load_file(tmp_path / "tuned/checkpoints/last/pretrained_model/model.safetensors")
    start = load_file(checkpoint / "model.safetensors")
    name = "planner.denoiser.motion_head.weight"
    assert not torch.equal(tuned[name], start[name])
    torch.testing.assert_close(tuned[name], start[name], atol=0.01, rtol=0)


def test_planners_are_known_where_mujoco_cannot_be_imported():
    """As on a robot's computer without EGL: LeRobot imports the plugin in every command."""
    code = "import sys; sys.modules['mujoco'] = None; import lerobot_policy_hdp; import lerobot.configs as c; "
    code += "print(c.PreTrainedConfig.get_choice_class('hdp')(horizon=3, device='cpu').type)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.stdout == "hdp\n", result.stderr


def test_weights_without_their_settings_are_refused(dataset_root, checkpoint, tmp_path):
    flags = train_flags(dataset_root, tmp_path / "run")
    with pytest.raises(ValueError, match=f"leave out --policy.type, and train on with --policy.path={checkpoint}"):
        call_command(lerobot_train.main, *flags, f"--policy.pretrained_path={checkpoint}")


def test_renamed_observations_are_normalised(dataset_root, checkpoint, tmp_path):
    """By the statistics of the new dataset, as those that keep their names."""
    recorded = LeRobotDataset("test/sorting", root=dataset_root, video_backend="pyav")
    states, column = np.stack(recorded.hf_dataset["observation.state"]), recorded.meta.features["observation.state"]
    added = {"observation.joints": (10 * states, {**column, "names": ["joint"] * 3})}
    other = modify_features(recorded, added, "observation.state", tmp_path / "other", "test/sorting")
    recompute_stats(other)
    flags = train_flags(other.root, tmp_path / "run", [f"--policy.path={checkpoint}"])
    call_command(hdp_train.main, *flags, '--rename_map={"observation.joints": "observation.state"}')
    tuned = tmp_path / "run/checkpoints/last/pretrained_model"
    preprocess, _ = make_pre_post_processors(HDPConfig.from_pretrained(tuned), tuned)
    state, poses = (recorded[0][key] for key in ("observation.state", "observation.environment_state"))
    renamed = preprocess({"observation.joints": 10 * state, "observation.environment_state": poses})
    preprocess, _ = make_pre_post_processors(HDPConfig.from_pretrained(checkpoint), checkpoint)
    as_before = preprocess({"observation.state": state, "observation.environment_state": poses})
    torch.testing.assert_close(renamed["observation.state"], as_before["observation.state"])


def test_training_refuses_what_does_not_fit(dataset_root, tmp_path):
    message = "up to 19 frames, the planner's horizon is 25: set --policy.horizon=19"
    with pytest.raises(ValueError, match=message):
        call_command(lerobot_train.main, *train_flags(dataset_root, tmp_path / "run"), "--policy.horizon=25")


def test_an_output_folder_that_holds_a_run_is_not_overwritten(dataset_root, run):
    with pytest.raises(FileExistsError, match="already exists"):
        call_command(lerobot_train.main, *train_flags(dataset_root, run[1]))


@pytest.fixture(scope="module")
def planned(checkpoint, tmp_path_factory) -> tuple[str, Path]:
    """What `hdp-plan` printed, and the folder that it wrote to. The task is in the checkpoint's configuration."""
    folder = tmp_path_factory.mktemp("plan")
    flags = (f"--output_dir={folder}", "--prompt=PICK b from s1", f"--html={folder / 'page' / 'plan.html'}")
    result = run_command("hdp-plan", f"--policy.path={checkpoint}", "--policy.num_candidates=2", "--check=true", *flags)
    return result.stdout, folder


def test_hdp_plan_prints_and_draws_a_plan(planned):
    printed, folder = planned
    assert "plan:\n    waypoints 0-6     PICK 1.00  B 1.00  S1 1.00 " in printed
    assert "checked: " in printed
    assert "checked: valid" not in printed
    assert re.search(r"executed: score 0\.\d\d, failure", printed)
    from PIL import Image

    assert Image.open(folder / "plan.png").size[0] > 300
    assert Image.open(folder / "denoising.gif").n_frames == 11


class TestPage:
    """The page of `hdp-plan --html`, in a real browser without a network."""

    @pytest.fixture(scope="class")
    def seen(self, planned, tmp_path_factory) -> list[dict]:
        """What the page shows at first, and after each movement of a slider."""
        html = (planned[1] / "page" / "plan.html").read_text()
        errors = "<script>const errors = []; addEventListener('error', (event) => errors.push(event.message));</script>"
        html = html.replace("<head>", "<head>" + errors).replace("</body>", f"<script>{MOVE_SLIDERS}</script></body>")
        page = tmp_path_factory.mktemp("browser") / "plan.html"
        page.write_text(html)
        [report] = re.findall(r'<pre id="report">(.*?)</pre>', open_in_browser(page), re.DOTALL)
        return json.loads(unescape(report))

    def test_needs_nothing_but_itself(self, planned):
        html = (planned[1] / "page" / "plan.html").read_text()
        assert "PLAN_DATA;" not in html
        assert not re.search(r"https?://|(src|href)=\"(?!data:)", html)

    def test_loads_without_errors(self, seen):
        assert seen[-1]["errors"] == []
        assert seen[0]["masked"] == 0
        assert seen[0]["given"] == ["PICK", "B", "S1"]
        assert seen[0]["at"] == ["waypoint 0", "step 10 of 10"]

    def test_the_time_slider_moves_the_tool_the_scene_and_the_step(self, seen):
        first, fifth, ninth = seen[:3]
        assert first["active"] == fifth["active"] == first["words"][:6]
        assert ninth["active"] == first["words"][6:12]
        assert first["tool"] != fifth["tool"] != ninth["tool"]
        assert len({look["frame"] for look in (first, fifth, ninth)}) == 3
        assert first["path"] == ninth["path"]

    def test_the_denoising_slider_hides_tokens_and_deforms_the_path(self, seen):
        plan, noise, between = seen[2:5]
        assert noise["masked"] == len(plan["words"]) - 3
        assert noise["given"] == ["PICK", "B", "S1"]
        assert 0 <= between["masked"] < noise["masked"]
        assert len({look["path"] for look in (plan, noise, between)}) == 3
        assert noise["active"] == []
        assert noise["at"][1] == "step 0 of 10"

    def test_the_time_slider_leads_back_to_the_finished_plan(self, seen):
        assert seen[5]["masked"] == 0
        assert seen[5]["at"] == ["waypoint 18", "step 10 of 10"]
        assert seen[5]["path"] == seen[0]["path"]


MOVE_SLIDERS = """
    const seen = [];
    const texts = (selector) => [...document.querySelectorAll(selector)].map((token) => token.textContent);
    const look = () => seen.push({
        errors, words: texts("#tokens .token"), active: texts("#tokens .token.active"),
        given: texts("#tokens .token.given"), masked: texts("#tokens .token.masked").length,
        frame: document.getElementById("frame").getAttribute("href"),
        path: document.getElementById("path").getAttribute("points"),
        tool: ["cx", "cy"].map((name) => document.getElementById("tool").getAttribute(name)),
        at: ["time-at", "denoising-at"].map((id) => document.getElementById(id).textContent),
    });
    const move = (id, value) => {
        document.getElementById(id).value = value;
        document.getElementById(id).dispatchEvent(new Event("input"));
        look();
    };
    look(); move("time", 5); move("time", 9); move("denoising", 0); move("denoising", 6); move("time", 18);
    const report = document.createElement("pre");
    report.id = "report";
    report.textContent = JSON.stringify(seen);
    document.body.append(report);
"""


def open_in_browser(page: Path) -> str:
    """The page's DOM after its scripts have run. Debian's package `chromium` is enough."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("there is no Chromium on this machine (Debian, Ubuntu: apt-get install chromium)")
    flags = ("--headless", "--no-sandbox", "--disable-gpu", "--host-resolver-rules=MAP * ~NOTFOUND")
    profile = f"--user-data-dir={page.parent / 'profile'}"
    command = [browser, *flags, profile, "--dump-dom", page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout


def test_hdp_plan_explains_a_recorded_motion(checkpoint, dataset_root, capsys):
    """Of the dataset in the checkpoint's training configuration. The planner is as good as untrained."""
    call_command(hdp_plan.main, f"--policy.path={checkpoint}", "--explain=2")
    printed = capsys.readouterr().out
    _, first, *_, last = printed[printed.index("episode 2:") :].splitlines()
    assert first.startswith("    waypoints 0-6 ")
    dataset = LeRobotDataset("test/sorting", root=dataset_root, video_backend="pyav")
    vocabulary = Vocabulary(dataset.meta.features["observation.symbolic_plan"]["info"]["vocabulary"])
    recorded = vocabulary.decode(dataset[2 * HORIZON]["observation.symbolic_plan"])
    assert last == f"recorded: {' '.join(recorded)}"


def test_hdp_plan_explains_an_episode_shorter_than_its_plans(checkpoint, dataset, tmp_path, capsys):
    features = {key: dataset.features[key] for key in ("observation.state", "observation.environment_state", "action")}
    options = {"fps": dataset.fps, "root": tmp_path / "short", "features": features, "use_videos": False}
    short = LeRobotDataset.create("test/short", **options)
    for row in dataset.hf_dataset.select(range(12)):
        short.add_frame({**{key: row[key] for key in features}, "task": "sort"})
    short.save_episode()
    short.finalize()
    source = ("--dataset.repo_id=test/short", f"--dataset.root={short.root}")
    call_command(hdp_plan.main, f"--policy.path={checkpoint}", *source, "--explain=0")
    assert "episode 0:\n    waypoints 0-6 " in capsys.readouterr().out


def test_hdp_plan_explains_a_dataset_without_symbols_and_without_a_task(checkpoint, dataset_root, tmp_path, capsys):
    bare, policy = tmp_path / "bare", tmp_path / "policy"
    call_command(
        lerobot_edit_dataset.main,
        "--repo_id=test/sorting",
        f"--root={dataset_root}",
        "--new_repo_id=test/bare",
        f"--new_root={bare}",
        "--operation.type=remove_feature",
        "--operation.feature_names=['observation.symbolic_plan']",
    )
    shutil.copytree(checkpoint, policy)
    config = json.loads((policy / "train_config.json").read_text())
    (policy / "train_config.json").write_text(json.dumps({**config, "env": None}))
    flags = (f"--policy.path={policy}", "--dataset.repo_id=test/bare", f"--dataset.root={bare}", "--explain=2")
    call_command(hdp_plan.main, *flags)
    assert capsys.readouterr().out.endswith("the dataset has no symbolic plans\n")
    flags = (*flags[:2], f"--dataset.root={tmp_path / 'nowhere'}", "--explain=2")
    with pytest.raises(SystemExit, match=r"^hdp-plan: the dataset test/bare is not in .*nowhere, nor to be had from"):
        call_command(hdp_plan.main, *flags)


def test_hdp_plan_does_not_plan_for_a_page_that_it_cannot_write(checkpoint, tmp_path):
    with pytest.raises(SystemExit, match=r"^hdp-plan: .* is a folder: name a file in it"):
        call_command(hdp_plan.main, f"--policy.path={checkpoint}", f"--html={tmp_path}")


def test_hdp_plan_compiles_a_planner_only_if_it_is_told_to(make_planner, tmp_path, monkeypatch):
    make_planner(compile_model=True)[0].save_pretrained(tmp_path)
    for flags, compiles in (((), False), (("--policy.compile_model=true",), True)):
        monkeypatch.setattr(sys, "argv", ["hdp-plan", f"--policy.path={tmp_path}", *flags])
        assert hdp_plan.PlanConfig(env=HDPEnv()).policy.compile_model == compiles


def test_hdp_plan_executes_a_plan_that_is_shorter_than_the_episode(make_planner, tmp_path, capsys):
    policy, *processors = make_planner(plan_from="any_frame", horizon=7)
    for saved in (policy, *processors):
        saved.save_pretrained(tmp_path / "policy")
    flags = (f"--policy.path={tmp_path / 'policy'}", f"--output_dir={tmp_path / 'plan'}", "--env.type=hdp", *TASK_FLAGS)
    call_command(hdp_plan.main, *flags)
    assert "executed: 7 actions, after which the episode goes on" in capsys.readouterr().out


@pytest.mark.parametrize("planner", ["diffuser", "joint_diffuser", "separate_diffuser", "hd", "chd"])
def test_hdp_plan_takes_every_planner(make_planner, planner, tmp_path, capsys):
    for saved in make_planner(planner):
        saved.save_pretrained(tmp_path / "policy")
    flags = (f"--policy.path={tmp_path / 'policy'}", f"--output_dir={tmp_path / 'plan'}", "--env.type=hdp", *TASK_FLAGS)
    call_command(hdp_plan.main, *flags, f"--html={tmp_path / 'plan.html'}")
    said = capsys.readouterr().out
    models_symbols = planner in ("joint_diffuser", "separate_diffuser")
    assert ("checked: " in said) == models_symbols
    assert "executed: score" in said
    assert (tmp_path / "plan.html").stat().st_size > 10_000
    if not models_symbols:
        with pytest.raises(SystemExit, match="this planner models no symbols"):
            call_command(hdp_plan.main, *flags, "--prompt=PICK B")


def test_hdp_plan_takes_a_planner_without_its_training_configuration(checkpoint, tmp_path, capsys):
    """As `policy.push_to_hub` uploads it."""
    policy = tmp_path / "policy"
    shutil.copytree(checkpoint, policy, ignore=shutil.ignore_patterns("train_config.json"))
    flags = [f"--policy.path={policy}", f"--output_dir={tmp_path / 'plan'}"]
    with pytest.raises(SystemExit, match="names no simulated task: choose one with --env"):
        call_command(hdp_plan.main, *flags)
    call_command(hdp_plan.main, *flags, "--env.type=hdp", *TASK_FLAGS)
    assert "plan:" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            ["--prompt=PICK D"],
            "unknown symbol 'D' (word 2 of the prompt); the symbols are PAD A B PICK PLACE S1 S2 AUX",
        ),
        (["--policy.prompt=PICK D"], "unknown symbol 'D' (word 2 of the prompt)"),
        (["--prompt=" + "PICK " * 19], "does not fit into a plan of 18 symbols"),
        (["--prompt=... PICK D ..."], "unknown symbol 'D' (word 3 of the prompt)"),
        (["--prompt=7: PICK 3: A"], "no room for what begins with '3:A' (word 2 of the prompt)"),
        (["--explain=0", "--prompt=PICK"], "--explain goes without --prompt"),
        (
            ["--explain=0", "--dataset.repo_id=no/where", "--dataset.root=outputs/none"],
            "no/where is not in outputs/none",
        ),
        (
            ["--env.type=hdp", "--env.n_blocks=3", "--env.waypoints_per_pose=1"],
            "the planner was trained for another task: its horizon is 19, here it is 37",
        ),
        (["--check=true"], "set --policy.num_candidates to more than 1"),
        (["--policy.path=nowhere/to/be/found"], "nowhere/to/be/found"),
        ([f"--explain={N_EPISODES}"], f"--explain={N_EPISODES}: the dataset has the episodes 0 to {N_EPISODES - 1}"),
    ],
)
def test_hdp_plan_answers_bad_input_with_one_line(checkpoint, tmp_path, monkeypatch, flags, message):
    arguments = {"--policy.path": f"--policy.path={checkpoint}"} | {flag.split("=")[0]: flag for flag in flags}
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        call_command(hdp_plan.main, *arguments.values(), f"--output_dir={tmp_path / 'none'}")
    assert message in end.value.code
    assert "\n" not in end.value.code
    assert not (tmp_path / "none").exists()


def test_lerobot_edit_dataset_keeps_the_vocabulary(dataset_root, tmp_path):
    copy = tmp_path / "sorting"
    shutil.copytree(dataset_root, copy)
    call_command(
        lerobot_edit_dataset.main,
        "--repo_id=test/sorting",
        f"--root={copy}",
        "--new_repo_id=test/shorter",
        f"--new_root={tmp_path / 'shorter'}",
        "--operation.type=delete_episodes",
        "--operation.episode_indices=[0, 3]",
    )
    dataset = LeRobotDataset("test/shorter", root=tmp_path / "shorter", video_backend="pyav")
    assert dataset.num_episodes == N_EPISODES - 2
    assert dataset.meta.features["observation.symbolic_plan"]["info"]["vocabulary"][3] == "PICK"


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_a_train_config_fits_its_task(path):
    config = TrainPipelineConfig.from_pretrained(path)
    assert config.policy.horizon == config.env.planning_task.horizon
    assert config.policy.push_to_hub is False
