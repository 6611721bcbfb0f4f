"""The page of results and the README's table say what is stored."""

import copy
import re

import pytest

from benchmarks.results_page import (
    BEGIN,
    END,
    METHODS_PAGE,
    PAGE,
    README,
    between,
    load,
    methods_with,
    readme_table,
    readme_with,
    results_page,
)


def test_results_page_is_up_to_date() -> None:
    assert PAGE.read_text("utf-8") == results_page(load()), "run python -m benchmarks.results_page"


def test_table_of_the_readme_is_up_to_date() -> None:
    text = README.read_text("utf-8")
    assert text == readme_with(text, readme_table(load())), "run python -m benchmarks.results_page"


def test_tables_of_the_methods_are_up_to_date() -> None:
    text = METHODS_PAGE.read_text("utf-8")
    assert "<!-- schedules -->" in text
    assert text == methods_with(text, load()), "run python -m benchmarks.results_page"


def test_schedules_are_those_of_the_recipes() -> None:
    text = methods_with("<!-- schedules -->\n<!-- /schedules -->\n", {})
    assert "| `humannerf_fast` | 400,000 | 3,000 |" in text
    assert "`motion_from` 200" in text
    assert "| `npc_fast` | 310,000 | 500 and 1,500 |" in text


def test_text_without_marks_stays() -> None:
    assert between("a\n", "<x>\n", "b\n", "</x>\n") == "a\n"


def test_readme_has_at_most_five_rows_of_results() -> None:
    table = README.read_text("utf-8").partition(BEGIN)[2].partition(END)[0]
    assert 1 <= len(table.splitlines()) - 2 <= 5


def test_numbers_come_from_the_stored_files() -> None:
    results = copy.deepcopy(load())
    step = results["step-cpu-2threads"]
    step["fast"]["median_s"], step["reference"]["median_s"] = 0.5, 150.0
    assert "0.50 s, 300 times faster than the reference form (150 s)" in readme_table(results)
    assert re.search(r"\| 2 \| `fast` \| 0\.50 s .*\| 300 \|", results_page(results))


def test_a_readme_without_marks_is_not_lost() -> None:
    assert readme_with(f"a\n{BEGIN}old\n{END}b\n", "new\n") == f"a\n{BEGIN}new\n{END}b\n"


@pytest.mark.parametrize("text", ["docs/responsible-use.md", "docs/results.md", "LICENSE", "arxiv.org/abs/2406.00637"])
def test_readme_links_what_a_reader_needs(text: str) -> None:
    assert text in README.read_text("utf-8")


def test_each_stored_result_says_on_what_and_at_which_commit_it_was_measured() -> None:
    for name, result in load().items():
        if name != "captures":
            assert re.fullmatch("[0-9a-f]{7,}", result["commit"]), name
            assert result["machine"]["processor"], name


def test_pages_name_commits_and_processors() -> None:
    results = copy.deepcopy(load())
    for result in (results["step-cpu-1threads"], results["step-cpu-2threads"]):
        result |= {"commit": "abc1234", "machine": {"processor": "Made Up 9"}}
    assert "float32. Commit abc1234, Made Up 9. `python -m benchmarks.step`" in results_page(results)
    results["step-cpu-2threads"]["commit"] = "def5678"
    assert "Commits abc1234 and def5678, Made Up 9." in results_page(results)
