"""The language of prompts, and which of its placements a planner chooses."""

import pytest
import torch
from draccus.utils import ParsingError

from lerobot_hdp import FREE, HDPConfig, PlanPrompt, Vocabulary
from lerobot_hdp.prompt import choose_placement, encode_prompt, shared_tokens

VOCABULARY = Vocabulary(["PAD", "RED", "GREEN", "BLUE", "DRAG", "STACK"])
LENGTH = 6


def placements(prompt: str, vocabulary: Vocabulary = VOCABULARY, length: int = LENGTH) -> list[str]:
    """Each placement in words: `_` is free, `.` is PAD."""
    words = dict(enumerate(vocabulary.symbols)) | {FREE: "_", vocabulary.pad_id: "."}
    return [" ".join(words[i] for i in row) for row in encode_prompt(prompt, vocabulary, length).tolist()]


@pytest.mark.parametrize(
    ("prompt", "expected"),
    [
        ("", ["_ _ _ _ _ _"]),
        ("DRAG RED", ["DRAG RED _ _ _ _"]),
        ("DRAG RED ...", ["DRAG RED _ _ _ _"]),
        ("DRAG _ DRAG", ["DRAG _ DRAG _ _ _"]),
        ("_ RED", ["_ RED _ _ _ _"]),
        ("3:STACK RED", ["_ _ STACK RED _ _"]),
        ("DRAG 4:RED", ["DRAG _ _ RED _ _"]),
        ("DRAG ... 6:RED", ["DRAG _ _ _ _ RED"]),
        ("DRAG RED PAD", ["DRAG RED . . . ."]),
        ("... DRAG RED DRAG BLUE STACK", ["DRAG RED DRAG BLUE STACK .", "_ DRAG RED DRAG BLUE STACK"]),
        ("-5:DRAG RED DRAG BLUE STACK", ["DRAG RED DRAG BLUE STACK .", "_ DRAG RED DRAG BLUE STACK"]),
        ("-5:DRAG", ["DRAG _ _ _ _ .", "_ DRAG _ _ _ _"]),
        ("DRAG RED ... STACK RED _", ["DRAG RED STACK RED _ .", "DRAG RED _ STACK RED _"]),
        (
            "DRAG RED ... BLUE",
            ["DRAG RED BLUE . . .", "DRAG RED _ BLUE . .", "DRAG RED _ _ BLUE .", "DRAG RED _ _ _ BLUE"],
        ),
        ("DRAG RED ... BLUE GREEN STACK ...", ["DRAG RED BLUE GREEN STACK _", "DRAG RED _ BLUE GREEN STACK"]),
        ("... 5:BLUE ... PAD", ["_ _ _ _ BLUE ."]),
    ],
)
def test_where_the_words_of_a_prompt_may_stand(prompt, expected):
    assert placements(prompt) == expected


@pytest.mark.parametrize(
    "prompt",
    ["... stack red", " ...  Stack   RED ", "...STACK red", "… STACK to RED", "... ... STACK RED", "-2 : STACK RED"],
)
def test_case_spacing_and_filler_words_do_not_matter(prompt):
    assert placements(prompt) == placements("... STACK RED")


def test_filler_words_can_be_symbols():
    vocabulary = Vocabulary(["PAD", "GO", "TO", "A"])
    assert placements("go to a", vocabulary, 3) == ["GO TO A"]
    assert placements("go from a", vocabulary, 3) == ["GO A _"]


@pytest.mark.parametrize(
    ("prompt", "message"),
    [
        (
            "DRAG PURPLE",
            r"unknown symbol 'PURPLE' \(word 2 of the prompt\); the symbols are PAD RED GREEN BLUE DRAG STACK",
        ),
        ("... STACK 5:re", r"unknown symbol 're' \(word 3 of the prompt\)"),
        ("0:RED", r"'0:RED' \(word 1 of the prompt\): positions count from 1"),
        ("7:RED", "'7:RED' does not fit into a plan of 6 symbols"),
        ("-7:RED", "does not fit"),
        ("-1:STACK RED", "does not fit"),
        ("RED " * 7, "does not fit"),
        ("DRAG RED 2:BLUE", "its parts overlap or are out of order"),
        ("PAD RED", "does not fit"),
    ],
)
def test_a_mistake_is_named_with_its_place(prompt, message):
    with pytest.raises(ValueError, match=message):
        encode_prompt(prompt, VOCABULARY, LENGTH)


def test_too_many_ways_to_place_a_prompt_are_refused():
    with pytest.raises(ValueError, match="too many ways"):
        encode_prompt("... RED ... RED ... RED ... RED ... RED ...", VOCABULARY, 40)


def test_the_placement_that_the_planner_finds_likely_is_chosen():
    """Its plans have four symbols: STACK RED at the third and fourth position, then PAD."""
    ways = encode_prompt("... STACK RED", VOCABULARY, LENGTH)
    logits = torch.zeros(LENGTH, len(VOCABULARY))
    for position, word in enumerate(["DRAG", "BLUE", "STACK", "RED", "PAD", "PAD"]):
        logits[position, VOCABULARY.token_id(word)] = 12.0
    assert (shared_tokens(ways) == FREE).all()
    assert choose_placement(ways, logits).tolist() == [FREE, FREE, 5, 1, 0, 0]


def test_equally_likely_placements_are_drawn_equally_often():
    ways = encode_prompt("... STACK ...", VOCABULARY, 3)
    logits = torch.zeros(3, len(VOCABULARY))
    logits[2, VOCABULARY.token_id("STACK")] = -20.0
    drawn = [choose_placement(ways, logits).tolist().index(5) for _ in range(200)]
    assert 60 < drawn.count(0) < 140
    assert drawn.count(2) == 0


class TestThroughThePolicy:
    def test_words_are_followed(self, make_planner, inputs):
        policy, *_ = make_planner()
        plan = policy.eval().plan(inputs, "PICK B from S1 PLACE _ to AUX")
        assert all(plan.symbols(i)[:4] + plan.symbols(i)[5:6] == ["PICK", "B", "S1", "PLACE", "AUX"] for i in range(4))

    def test_each_sample_has_its_own_prompt(self, make_planner, inputs):
        policy, *_ = make_planner()
        plan = policy.eval().plan(inputs, ["PICK A", "PICK B", "", "... PLACE A S1 PAD"])
        assert plan.symbols(0)[:2] == ["PICK", "A"]
        assert plan.symbols(1)[:2] == ["PICK", "B"]
        assert plan.symbols(3)[-3:] == ["PLACE", "A", "S1"]
        with pytest.raises(ValueError, match="2 prompts for 4 observations"):
            policy.plan(inputs, ["PICK A", "PICK B"])

    def test_the_configuration_gives_a_prompt_to_every_plan(self, make_planner, inputs, tmp_path):
        policy, *_ = make_planner(prompt="PICK B")
        plan = policy.eval().plan({**inputs, "observation.symbolic_plan": torch.zeros(4, 18, dtype=torch.int64)})
        assert [plan.symbols(i)[:2] for i in range(4)] == [["PICK", "B"]] * 4
        assert policy.plan(inputs, "PICK A").symbols()[:2] == ["PICK", "A"]

    def test_a_wrong_prompt_in_the_configuration_is_refused_when_a_checkpoint_is_loaded(self, make_planner, tmp_path):
        policy, *_ = make_planner()
        policy.save_pretrained(tmp_path)
        with pytest.raises(ParsingError, match="unknown symbol 'D'"):
            HDPConfig.from_pretrained(tmp_path, cli_overrides=["--prompt=PICK D"])

    def test_words_and_a_motion_can_be_given_together(self, make_planner, inputs, batch):
        policy, preprocessor, _ = make_planner()
        token_ids = policy.eval().read_prompt(inputs, "PICK B").token_ids
        actions = preprocessor(batch)["action"]
        plan = policy.plan(inputs, PlanPrompt(token_ids=token_ids, actions=actions))
        assert torch.equal(plan.actions, actions)
        assert plan.symbols()[:2] == ["PICK", "B"]

    def test_a_planner_without_symbols_takes_no_words(self, make_planner, inputs):
        policy, *_ = make_planner("diffuser")
        with pytest.raises(ValueError, match="takes no symbolic prompt"):
            policy.eval().plan(inputs, "PICK A")
