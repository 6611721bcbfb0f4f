"""The first paragraph of the results follows from the stored numbers, whatever they are."""

import pytest

from benchmarks.results_page import _table
from benchmarks.study_section import against_methods, answer, differences, section

SEEDS = range(4)


def study(full, pairs=4, **others):
    """Novel-pose and novel-view PSNRs: each row is off `full` by so much, with a little noise."""

    def numbers(shift):
        by = {f"studio 101, seed {seed}": full + shift + 0.01 * (seed % 2) * shift for seed in range(pairs)}
        return {"novel_pose.psnr_box": by, "novel_view.psnr_box": by}

    names = {"s1c1": "w/o {s1, c1}", "s2c2": "w/o {s2, c2}", "feat": "w/o feat"}
    rows = {names[key]: numbers(shift) for key, shift in others.items()} | {"Ours": numbers(0.0)}
    return {
        "rows": rows, "steps": dict.fromkeys(rows, 900), "printed": {"Ours": {"pose PSNR": [29.69]},
                                                                    "w/o feat": {"pose PSNR": [29.15]}},
        "about": {"seeds": pairs, "subjects": ["studio 101"], "recipe": "quick", "settings": []},
        "extreme": {"bins": {"Ours": [[5.0, 26.0, 0.1, 4], [9.0, 24.0, 0.2, 4]]}},
    }  # fmt: skip


def test_positive_differences_are_those_in_which_the_full_model_is_better():
    found = differences(study(26.0, s1c1=-0.5, feat=0.25), "novel_pose.psnr_box", "high")
    assert found["w/o {s1, c1}"].mean == pytest.approx(0.5, abs=0.01)
    assert found["w/o feat"].mean == pytest.approx(-0.25, abs=0.01)
    assert "Ours" not in found


def test_answer_is_yes_where_the_full_model_beats_both_single_branches():
    text = answer(study(26.0, s1c1=-0.5, s2c2=-0.3, feat=0.2))
    assert "In novel poses the full model is better than w/o {s1, c1} and w/o {s2, c2}; worse than w/o feat." in text
    assert text.endswith("Two branches beat either one alone in novel poses, as the paper says.")


def test_answer_is_no_where_a_single_branch_is_better():
    assert answer(study(26.0, s1c1=0.5, s2c2=-0.3)).endswith("A single branch does as well or better in novel poses: "
                                                             "at this scale, no.")  # fmt: skip


def test_the_other_methods_are_named_by_verdict_with_their_steps():
    found = study(26.0, s1c1=-0.5, feat=0.25)
    found["steps"] = {"Ours": 350, "w/o {s1, c1}": 350, "w/o feat": 1200}
    expected = (
        " Of the other methods, after 350 or 1,200 steps each, it is better than w/o {s1, c1}; worse than w/o feat"
    )
    assert against_methods(found) == expected + " in novel poses."
    found["minutes"] = {"Ours": 1.25, "w/o {s1, c1}": 9.6, "w/o feat": 11.2}
    assert " trained for 10 to 11 minutes of one core each (itself: 1.2), it is better" in against_methods(found)


def test_rows_of_different_length_say_how_long_they_trained():
    found = study(26.0, s1c1=-0.5, feat=0.25)
    found |= {"steps": {"Ours": 350, "w/o {s1, c1}": 350, "w/o feat": 1200}, "minutes": {"Ours": 0.5, "w/o feat": 9.96}}
    text = section(found, _table)
    assert "| w/o feat | 1,200 steps, 10.0 min | **-0.25" in text
    assert "| w/o {s1, c1} | 350 steps | **+0.50" in text
    assert "recipe `quick`. Training of the full model: 350 steps, 0.5 min." in text


def test_rows_with_fewer_seeds_than_the_full_model_are_named():
    found = study(26.0, s1c1=-0.5, s2c2=-0.4, feat=0.25)
    assert "4 seeds each, recipe" in section(found, _table)
    for row, count in (("w/o {s1, c1}", 2), ("w/o feat", 2), ("w/o {s2, c2}", 3)):
        numbers = found["rows"][row]
        found["rows"][row] = {metric: dict(list(by.items())[:count]) for metric, by in numbers.items()}
    expected = "4 seeds each (w/o {s1, c1} and w/o feat 2 of 4 trainings; w/o {s2, c2} 3 of 4 trainings), recipe"
    assert expected in section(found, _table)


def test_the_paper_is_named_only_where_it_has_a_number():
    found = study(26.0, feat=0.25)
    assert "the paper's difference on its subject 394" in section(found, _table)
    assert "the paper" not in section(found | {"printed": {}}, _table)


def test_one_pair_decides_nothing():
    assert "A single training of each decides nothing" in answer(study(26.0, pairs=1, s1c1=-3.0, s2c2=-3.0))


def test_section_has_a_row_for_each_ablation_and_the_papers_difference():
    text = section(study(26.0, s1c1=-0.5, feat=-0.25), _table)
    assert "| w/o feat | **+0.25 ± 0.00**, 4 of 4 (+0.54) | **+0.25 ± 0.00**, 4 of 4 |" in text
    assert "| Ours | 26.00 ± 0.10 dB at 5.0° | 24.00 ± 0.20 dB at 9.0° |" in text
    assert "1 held-out synthetic subject, 4 seeds each, recipe `quick` with 900 steps" in text
