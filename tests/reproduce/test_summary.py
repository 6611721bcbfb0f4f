"""Means, spreads, marks and pairwise comparisons of tables."""

import math
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twofold.reproduce.summary import Value, compared, marks, summarized

NUMBERS = st.floats(-100, 100)


@given(st.lists(st.lists(NUMBERS, min_size=3, max_size=3), min_size=2, max_size=5))
def test_spread_is_that_of_the_means_over_subjects_between_seeds(rows):
    value = summarized({(f"p{p}", seed): x for seed, row in enumerate(rows) for p, x in enumerate(row)})
    means = [sum(row) / 3 for row in rows]
    assert value.mean == pytest.approx(sum(means) / len(means), abs=1e-9)
    assert value.spread == pytest.approx(statistics.stdev(means), abs=1e-9)
    assert (value.seeds, value.subjects, value.missing) == (len(rows), 3, 0)


def test_difference_between_subjects_is_no_spread():
    assert summarized({("a", 0): 10.0, ("b", 0): 30.0, ("a", 1): 10.0, ("b", 1): 30.0}).spread == 0


def test_one_seed_has_no_spread():
    assert summarized({("a", 0): 1.0, ("b", 0): 3.0}) == Value(2.0, None, 1, 2)


def test_seed_without_all_subjects_is_left_out_and_counted_as_missing():
    value = summarized({("a", 0): 1.0, ("b", 0): 3.0, ("a", 1): 100.0, ("b", 1): None})
    assert (value.mean, value.spread, value.seeds, value.missing) == (2.0, None, 1, 1)


def test_where_no_seed_is_whole_the_mean_is_of_what_there_is():
    value = summarized({("a", 0): 1.0, ("b", 0): None, ("a", 1): None, ("b", 1): 4.0})
    assert (value.mean, value.spread, value.missing) == (2.5, None, 2)


def test_sentence_in_place_of_a_number_becomes_the_note():
    value = summarized({("a", 0): "n/a (put FILE at PLACE)"})
    assert value.mean is None
    assert value.note == "n/a (put FILE at PLACE)"


def test_nothing_is_marked_without_spread():
    assert marks([Value(30.0, None, 1), Value(20.0, None, 1)], "high") == ["", ""]


def test_lower_is_better_where_the_column_says_so():
    values = [Value(1.0, 0.1), Value(3.0, 0.1), Value(2.0, 0.1)]
    assert marks(values, "low") == ["best", "", "second"]
    assert marks(values, "high") == ["", "best", "second"]


def test_difference_has_to_exceed_the_larger_spread():
    assert marks([Value(2.0, 0.1), Value(1.0, 1.0)], "high") == ["", ""]
    assert marks([Value(2.0, 1.0), Value(1.0, 0.1)], "high") == ["", ""]
    assert marks([Value(2.0, 0.9), Value(1.0, 0.9)], "high") == ["best", ""]


def test_second_is_not_marked_where_it_ties_with_the_third():
    assert marks([Value(5.0, 0.1), Value(3.0, 0.2), Value(2.9, 0.2)], "high") == ["best", "", ""]


def test_row_with_missing_cells_is_never_marked():
    assert marks([Value(9.0, 0.1, missing=1), Value(3.0, 0.1), Value(2.0, 0.1)], "high") == ["", "best", ""]


@given(st.lists(st.tuples(NUMBERS, st.floats(0, 10)), min_size=2, max_size=6))
def test_at_most_one_best_and_it_is_the_extreme(rows):
    values = [Value(mean, spread) for mean, spread in rows]
    found = marks(values, "high")
    assert found.count("best") <= 1
    assert found.count("second") <= found.count("best")
    if "best" in found:
        assert values[found.index("best")].mean == max(mean for mean, _ in rows)


def test_pairs_are_of_equal_subject_and_seed():
    first = {("a", 0): 2.0, ("a", 1): 3.0, ("b", 0): 50.0}
    second = {("a", 0): 1.0, ("a", 1): 2.5, ("c", 0): 9.0}
    difference = compared(first, second, "high")
    assert difference is not None
    assert (difference.mean, difference.pairs, difference.wins) == (0.75, 2, 2)
    assert difference.deviation == pytest.approx(statistics.stdev([1.0, 0.5]))
    assert compared(first, {("z", 0): 1.0}, "high") is None


@pytest.mark.parametrize(("shift", "verdict"), [(2.1, "better"), (1.9, "undecided"), (-2.1, "worse")])
def test_verdict_needs_two_standard_errors(shift, verdict):
    # Differences shift +- 1 in four pairs: the standard error is their deviation over 2.
    error = statistics.stdev([1, -1, 1, -1]) / math.sqrt(4)
    noise = {("a", k): shift * error + (1 if k % 2 else -1) for k in range(4)}
    difference = compared(noise, {("a", k): 0.0 for k in range(4)}, "high")
    assert difference is not None
    assert difference.verdict == verdict


def test_single_pair_decides_nothing():
    difference = compared({("a", 0): 9.0}, {("a", 0): 1.0}, "high")
    assert difference is not None
    assert difference.verdict == "undecided"


def test_lower_numbers_win_where_lower_is_better():
    difference = compared({("a", 0): 1.0, ("a", 1): 1.0}, {("a", 0): 3.0, ("a", 1): 2.0}, "low")
    assert difference is not None
    assert (difference.mean, difference.wins) == (1.5, 2)
