"""Symbols in words, token ids, and back."""

import pytest
import torch

from lerobot_hdp import Vocabulary

VOCABULARY = Vocabulary(["PAD", "A", "B", "PICK", "PLACE", "S1"])


def test_a_plan_survives_the_way_to_ids_and_back():
    ids = VOCABULARY.encode("PICK A S1 PLACE", length=6)
    assert ids.tolist() == [3, 1, 5, 4, 0, 0]
    assert VOCABULARY.decode(ids) == ["PICK", "A", "S1", "PLACE"]


def test_case_and_spacing_do_not_matter():
    assert torch.equal(VOCABULARY.encode("  pick   a", 3), VOCABULARY.encode(["PICK", "A"], 3))


def test_the_mask_is_no_symbol():
    with pytest.raises(ValueError, match="token id 6 at position 0"):
        VOCABULARY.decode([len(VOCABULARY)])


def test_an_unknown_symbol_is_named_with_its_place_and_the_choices():
    with pytest.raises(ValueError, match=r"unknown symbol 'PIKC' at position 2; the symbols are PAD A B PICK"):
        VOCABULARY.encode("PICK PIKC", length=4)


def test_a_plan_longer_than_the_horizon_is_refused():
    with pytest.raises(ValueError, match="3 symbols do not fit into a plan of 2"):
        VOCABULARY.encode("PICK A S1", length=2)


def test_a_free_position_is_no_part_of_a_whole_plan():
    with pytest.raises(ValueError, match="unknown symbol '_'"):
        VOCABULARY.encode("PICK _", length=4)


def test_symbols_are_named_once():
    with pytest.raises(ValueError, match="each once"):
        Vocabulary(["PAD", "A", "a"])


def test_the_first_symbol_is_pad():
    with pytest.raises(ValueError, match="the first symbol of a vocabulary is PAD"):
        Vocabulary(["A", "B"])
