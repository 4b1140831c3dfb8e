"""The language of prompts, and which of its placements a planner chooses."""

import pytest
import torch
from draccus.utils import ParsingError

from lerobot_hdp import FREE, FREE_SYMBOL, HDPConfig, PlanPrompt, Vocabulary
from lerobot_hdp.prompt import choose_placement, encode_prompt, shared_tokens
from lerobot_hdp.vocabulary import PAD_ID

VOCABULARY = Vocabulary(["PAD", "RED", "GREEN", "BLUE", "DRAG", "STACK"])
LENGTH = 6


def placements(prompt: str, vocabulary: Vocabulary = VOCABULARY, length: int = LENGTH) -> list[str]:
    """Each placement in words: `_` is free, `.` is PAD."""
    words = dict(enumerate(vocabulary.symbols)) | {FREE: "_", FREE_SYMBOL: "_", PAD_ID: "."}
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
        ("... PAD", ["_ _ _ _ _ _"]),
        ("DRAG RED ... PAD", ["DRAG RED _ _ _ _"]),
        ("... 5:BLUE ... PAD", ["_ _ _ _ BLUE _"]),
        (
            "... STACK RED PAD",
            ["STACK RED . . . .", "_ STACK RED . . .", "_ _ STACK RED . .", "_ _ _ STACK RED .", "_ _ _ _ STACK RED"],
        ),
        ("DRAG RED DRAG BLUE STACK RED PAD", ["DRAG RED DRAG BLUE STACK RED"]),
        ("5:PAD", ["_ _ _ _ . ."]),
        ("_ ... 6:RED", ["_ _ _ _ _ RED"]),
        ("DRAG ... _ ... -1:RED", ["DRAG _ RED . . .", "DRAG _ _ RED . .", "DRAG _ _ _ RED .", "DRAG _ _ _ _ RED"]),
        ("4:DRAG RED ... _", ["_ _ _ DRAG RED _"]),
    ],
)
def test_where_the_words_of_a_prompt_may_stand(prompt, expected):
    assert placements(prompt) == expected


def test_where_the_plan_has_not_ended_only_pad_is_excluded():
    assert encode_prompt("DRAG _", VOCABULARY, LENGTH).tolist() == [[4, FREE_SYMBOL, FREE, FREE, FREE, FREE]]
    assert encode_prompt("-6:DRAG", VOCABULARY, LENGTH).tolist() == [[4] + [FREE_SYMBOL] * 5]
    assert encode_prompt("5:PAD", VOCABULARY, LENGTH).tolist() == [[FREE_SYMBOL] * 4 + [PAD_ID] * 2]


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
        ("7:RED", r"'7:RED' \(word 1 of the prompt\) is outside of a plan of 6 symbols"),
        ("... RED 7:_", r"'7:_' \(word 3 of the prompt\) is outside"),
        ("-7:RED", r"'-7:RED' \(word 1 of the prompt\) is outside"),
        ("-1:STACK RED", r"no room for what begins with '-1:STACK' \(word 1"),
        ("-2:STACK PAD", r"no room for what begins with '-2:STACK' \(word 1"),
        ("RED " * 7, r"no room for what begins with 'RED' \(word 1"),
        ("_ " * 7, r"no room for what begins with '_' \(word 1"),
        ("DRAG RED 2:BLUE STACK", r"no room for what begins with '2:BLUE' \(word 3"),
        ("DRAG ... 3:RED 1:BLUE", r"no room for what begins with '1:BLUE' \(word 4"),
        ("DRAG PAD RED", r"'RED' \(word 3 of the prompt\) comes after PAD, where the plan has ended"),
        ("2:...", r"'2:\.\.\.' \(word 1 of the prompt\): a position is that of a symbol"),
    ],
)
def test_a_mistake_is_named_with_its_place(prompt, message):
    with pytest.raises(ValueError, match=message):
        encode_prompt(prompt, VOCABULARY, LENGTH)


@pytest.mark.parametrize("symbol", ["_", "...", "put down", "7:A", ""])
def test_what_no_prompt_could_name_is_no_symbol(symbol):
    with pytest.raises(ValueError, match="cannot be a symbol"):
        Vocabulary(["PAD", "A", symbol])


def test_an_impossible_prompt_is_refused_without_trying_all_ways_to_place_its_beginning():
    with pytest.raises(ValueError, match=r"no room for what begins with '3:RED'"):
        encode_prompt("... RED ... GREEN ... BLUE ... DRAG ... STACK ... 3:RED", VOCABULARY, 108)


def test_too_many_ways_to_place_a_prompt_are_refused():
    with pytest.raises(ValueError, match="too many ways"):
        encode_prompt("... RED ... RED ... RED ... RED ... RED ...", VOCABULARY, 40)


def test_the_placement_that_the_planner_finds_likely_is_chosen():
    """Its plans have four symbols: STACK RED at the third and fourth position, then PAD."""
    ways = encode_prompt("... STACK RED", VOCABULARY, LENGTH)
    logits = torch.zeros(LENGTH, len(VOCABULARY))
    for position, word in enumerate(["DRAG", "BLUE", "STACK", "RED", "PAD", "PAD"]):
        logits[position, VOCABULARY.token_id(word)] = 12.0
    assert (shared_tokens(ways) < 0).all()
    assert choose_placement(ways, logits).tolist() == [FREE_SYMBOL, FREE_SYMBOL, 5, 1, 0, 0]


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

    @pytest.mark.parametrize("num_candidates", [1, 3])
    def test_too_few_prompts_are_counted_as_they_were_given(self, make_planner, inputs, num_candidates):
        policy, *_ = make_planner()
        with pytest.raises(ValueError, match="2 prompts for 4 observations"):
            policy.eval().plan(inputs, ["PICK A", "PICK B"], num_candidates=num_candidates)
        with pytest.raises(ValueError, match=r"token_ids must have the shape \(4, 18\)"):
            policy.plan(inputs, PlanPrompt(torch.zeros(2, 18, dtype=torch.int64)), num_candidates=num_candidates)

    def test_a_plan_may_end_where_the_planners_room_does(self, make_planner, inputs):
        """Its plans have 18 symbols at most; an untrained planner finds all lengths equally likely."""
        policy, *_ = make_planner()
        plan = policy.eval().plan({key: value.repeat(60, 1) for key, value in inputs.items()}, "... PLACE A _ PAD")
        words = [plan.symbols(i) for i in range(240)]
        assert all(symbols[-3:-1] == ["PLACE", "A"] for symbols in words)
        assert max(map(len, words)) == 18

    def test_before_a_given_symbol_there_is_no_end(self, make_planner, inputs):
        policy, *_ = make_planner()
        plan = policy.eval().plan(inputs, "17:S1")
        assert (plan.token_ids[:, :17] != PAD_ID).all()

    def test_each_candidate_draws_its_own_places(self, make_planner, inputs):
        policy, *_ = make_planner()
        states = []
        policy.eval().plan(inputs, "... AUX ...", num_candidates=8, on_step=lambda _, state: states.append(state))
        given = states[0].tokens.unflatten(0, (4, 8)) != policy.symbol_process.mask_id
        assert (given.sum(dim=2) == 1).all()
        assert all(len(set(sample.long().argmax(dim=1).tolist())) > 1 for sample in given)

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"token_ids": torch.full((4, 18), 8)}, r"token_ids must be in \[0, 7\], or -1"),
            ({"token_ids": torch.full((4, 18), -3)}, r"token_ids must be in \[0, 7\], or -1"),
            ({"token_ids": torch.zeros(4, 18)}, "token_ids must have .* the type torch.int64"),
            ({"token_ids": torch.zeros(18, dtype=torch.int64)}, r"token_ids must have the shape \(4, 18\)"),
            ({"actions": torch.zeros(4, 19, 3, dtype=torch.float64)}, "actions must have .* the type torch.float32"),
            ({"actions": torch.full((4, 19, 3), torch.nan)}, "actions hold NaN or infinity"),
            (
                {"actions": torch.zeros(4, 19, 3), "actions_given": torch.ones(4, 18, dtype=torch.bool)},
                r"actions_given must have the shape \(4, 19\)",
            ),
            (
                {"actions": torch.zeros(4, 19, 3), "actions_given": torch.ones(4, 19)},
                "actions_given must have .* the type torch.bool",
            ),
        ],
    )
    def test_a_prompt_of_tensors_is_checked(self, make_planner, inputs, given, message):
        policy, *_ = make_planner()
        with pytest.raises(ValueError, match=message):
            policy.eval().plan(inputs, PlanPrompt(**given))

    @pytest.mark.parametrize("sampler", ["ddpm", "confidence"])
    def test_a_sample_of_which_all_is_given_stays_clean_whatever_the_others_have(self, make_planner, inputs, sampler):
        policy, *_ = make_planner(sampler=sampler)
        given = torch.zeros(4, 19, dtype=torch.bool)
        given[0] = True
        tokens = torch.full((4, 18), FREE)
        tokens[0] = 3
        actions, states = torch.rand(4, 19, 3), []
        prompt = PlanPrompt(token_ids=tokens, actions=actions, actions_given=given)
        assert not prompt.gives_part_of_motion
        policy.eval().plan(inputs, prompt, on_step=lambda _, state: states.append(state))
        assert all(torch.equal(state.motion[0], actions[0]) for state in states)
        assert all((state.motion[1] != actions[1]).any() for state in states)

    def test_a_checker_needs_something_to_choose_from(self, make_planner, inputs):
        policy, *_ = make_planner()
        with pytest.raises(ValueError, match="set num_candidates to more than 1"):
            policy.eval().plan(inputs, check=lambda *_: [])

    def test_the_configuration_gives_a_prompt_to_every_plan(self, make_planner, inputs):
        policy, *_ = make_planner(prompt="PICK B")
        plan = policy.eval().plan({**inputs, "observation.symbolic_plan": torch.zeros(4, 18, dtype=torch.int64)})
        assert [plan.symbols(i)[:2] for i in range(4)] == [["PICK", "B"]] * 4
        assert policy.plan(inputs, "PICK A").symbols()[:2] == ["PICK", "A"]

    def test_a_recorded_plan_is_no_prompt_and_one_with_an_open_place_is(self, make_planner, batch):
        policy, preprocessor, _ = make_planner()
        inputs = preprocessor(batch)
        assert not policy.read_prompt(inputs).tokens_mask.any()
        inputs["observation.symbolic_plan"][0, -1] = FREE
        given = policy.read_prompt(inputs)
        assert torch.equal(given.token_ids[0], inputs["observation.symbolic_plan"][0])
        assert given.tokens_mask.sum(dim=1).tolist() == [17, 0, 0, 0]

    def test_an_empty_prompt_gives_nothing_whatever_the_others_say(self, make_planner, batch):
        policy, preprocessor, _ = make_planner(prompt="PICK B")
        inputs = preprocessor(batch)
        inputs["observation.symbolic_plan"][0, -1] = FREE
        assert policy.read_prompt(inputs).tokens_mask.sum() == 2 * 4
        assert not policy.read_prompt(inputs, "").tokens_mask.any()
        policy.config.prompt = ""
        assert not policy.read_prompt(inputs).tokens_mask.any()

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
