# Everything runs in .venv, which is made on the first call. Needs Python 3.12 or newer as PYTHON.
PYTHON ?= python3
BIN := .venv/bin
OUT := outputs/quickstart
CONFIG := configs/block_sorting_2d_2_blocks.json
TASK := --env.task=BlockSorting2D-v0 --env.n_blocks=2 --env.waypoints_per_pose=1

export TOKENIZERS_PARALLELISM = false
# PyTorch's threads sleep while they wait for each other: on a CPU that others use, too, spinning is many times slower.
export OMP_WAIT_POLICY ?= passive

.PHONY: help setup quickstart test lint format clean

help:
	@echo "make setup        .venv with all that is needed"
	@echo "make quickstart   record, train, evaluate and plan on the smallest task (10 minutes on 2 cores)"
	@echo "make test         run the test suite"
	@echo "make lint         check style and types        make format   format the code"

setup: .venv/.installed

.venv/.installed: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 12) and "Python 3.12 or newer is needed: make PYTHON=python3.12")'
	test -x $(BIN)/uv || { $(PYTHON) -m venv .venv && $(BIN)/python -m pip install --quiet uv; }
	$(BIN)/uv pip install --quiet --compile-bytecode --python $(BIN)/python -e '.[dev]'
	touch $@

# The main job. Each step is skipped when it was done before; an interrupted one goes on.
quickstart: setup
	test -e $(OUT)/dataset || $(BIN)/hdp-record $(TASK) --resume=true --num_workers=2 \
		--dataset.repo_id=local/block_sorting_2d_2_blocks --dataset.root=$(OUT)/dataset --dataset.num_episodes=200
	@if [ -e $(OUT)/train/checkpoints/last ]; then \
		$(BIN)/hdp-train --resume=true --config_path=$(OUT)/train/checkpoints/last/pretrained_model/train_config.json; \
	else \
		rm -rf $(OUT)/train; \
		$(BIN)/hdp-train --config_path=$(CONFIG) --dataset.root=$(OUT)/dataset --output_dir=$(OUT)/train; \
	fi
	$(BIN)/lerobot-eval --policy.path=$(OUT)/train/checkpoints/last/pretrained_model --env.type=hdp $(TASK) --eval.n_episodes=50 \
		--eval.batch_size=50 --eval.use_async_envs=false --output_dir=$(OUT)/eval
	$(BIN)/hdp-plan --policy.path=$(OUT)/train/checkpoints/last/pretrained_model --seed=1 --output_dir=$(OUT)/plan
	@$(BIN)/python -c "import json; r = json.load(open('$(OUT)/eval/eval_info.json'))['overall']; \
		print(f\"success rate: {r['pc_success']:.0f} % of {r['n_episodes']} fresh starts; videos: $(OUT)/eval/videos\")"

test: setup
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest tests -n 2 --dist loadfile

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv $(OUT) build dist
