"""The paper's numbers are what it prints, and fit our tables."""

import statistics

import pytest

from twofold.reproduce.experiments import EXPERIMENTS
from twofold.reproduce.printed import AVERAGE, FOUR, METHODS, NOTES, PRINTED, SUBJECTS, printed

MAIN, BY_SUBJECT = PRINTED["main"][AVERAGE], PRINTED["subjects"]


@pytest.mark.parametrize("method", METHODS)
def test_averages_are_the_means_of_the_subjects_up_to_rounding(method):
    for column in FOUR:
        mean = statistics.mean(BY_SUBJECT[subject][method][column] for subject in SUBJECTS)
        assert MAIN[method][column] == pytest.approx(mean, abs=0.0006 if "SSIM" in column else 0.03)


def test_mean_of_the_geometry_is_the_one_of_the_appendix_not_of_the_main_table():
    subjects = [rows for subject, rows in PRINTED["wild"].items() if subject != AVERAGE]
    assert len(subjects) == 6
    assert statistics.mean(rows["Ours"]["CD"] for rows in subjects) == pytest.approx(0.048, abs=0.0003)
    assert PRINTED["wild"][AVERAGE]["Ours"]["CD"] == 0.047


def test_masked_vid2avatar_is_that_of_the_other_tables():
    for subject in SUBJECTS:
        assert PRINTED["masks"][subject]["V2A_mask"]["pose SSIM"] == BY_SUBJECT[subject]["Vid2Avatar"]["pose SSIM"]


def test_numbers_named_in_the_notes_are_in_the_tables():
    assert MAIN["PM-Avatar"]["view PSNR"] > MAIN["Ours"]["view PSNR"]
    assert 1 - MAIN["Ours"]["view LPIPS"] / MAIN["HumanNeRF"]["view LPIPS"] == pytest.approx(0.07, abs=0.005)
    assert PRINTED["wild"][AVERAGE]["NPC"]["Story FID"] < PRINTED["wild"][AVERAGE]["Ours"]["Story FID"]
    assert BY_SUBJECT["392"]["MonoHuman"]["pose KID"] < BY_SUBJECT["392"]["HumanNeRF"]["pose KID"] == 5.93
    assert BY_SUBJECT["393"]["MonoHuman"]["pose KID"] < BY_SUBJECT["393"]["HumanNeRF"]["pose KID"] == 10.70
    first, second = PRINTED["ablation"][AVERAGE]["Ours"], PRINTED["frequency"][AVERAGE]["[5, 10]"]
    assert first["view PSNR"] - second["view PSNR"] == pytest.approx(0.32)


@pytest.mark.parametrize("name", sorted(EXPERIMENTS))
def test_every_printed_row_and_column_has_a_place_in_our_table(name):
    experiment = EXPERIMENTS[name]
    rows = {row.printed for row in experiment.rows("quick", True)}
    columns = {column for ours in experiment.columns for column in ours.printed}
    for numbers in PRINTED[name].values():
        assert set(numbers) <= rows
        assert {column for row in numbers.values() for column in row} <= columns
    assert name in NOTES


@pytest.mark.parametrize("subject", ["377", "CoreView_377", "my_377", "zju-377-refined"])
def test_subject_is_found_by_its_number(subject):
    assert printed("subjects", subject, "Ours", "view PSNR") == 29.92


@pytest.mark.parametrize("subject", ["studio 101", "3770", "13773", "ada"])
def test_other_subjects_have_no_printed_numbers(subject):
    assert printed("subjects", subject, "Ours", "view PSNR") is None
