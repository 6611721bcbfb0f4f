"""A cell is named by what decides its training, and goes on where it stopped."""

from dataclasses import replace

import pytest
from stub_cells import store_results, stub_cells, stub_work
from tiny_person import tiny_recipe

from twofold.errors import TwofoldError
from twofold.inputs import read_json
from twofold.reproduce import cells
from twofold.reproduce.cells import CELL, FAILURE, RESULTS, RUN, Cell, read_cell, run_cell, store_cell
from twofold.reproduce.measuring import Measures
from twofold.reproduce.sources import FolderSource, StudioSource, folder_digest
from twofold.training import loop
from twofold.training.lock import locked

CELL_0 = stub_cells(1)[0]


def changed(**training):
    return replace(CELL_0, recipe=replace(CELL_0.recipe, training=replace(CELL_0.recipe.training, **training)))


@pytest.mark.parametrize(
    "other",
    [
        replace(CELL_0, recipe=replace(CELL_0.recipe, seed=1)),
        replace(CELL_0, source=StudioSource(102)),
        replace(CELL_0, source=StudioSource(101, size=64)),
        changed(steps=901),
    ],
)
def test_what_decides_the_training_changes_the_name(other):
    assert other.key != CELL_0.key


@pytest.mark.parametrize(
    "other",
    [
        replace(CELL_0, measures=Measures(max_images=5)),
        replace(CELL_0, recipe=replace(CELL_0.recipe, name="another")),
        changed(checkpoint_every=7),
        changed(preview_every=7),
    ],
)
def test_what_decides_no_number_of_the_training_does_not(other):
    assert other.key == CELL_0.key


def test_name_is_the_same_in_every_process():
    recipe = tiny_recipe()
    cell = Cell(FolderSource("somewhere", "0123"), recipe)
    assert cell.key == Cell(FolderSource("elsewhere", "0123"), recipe).key
    assert len(cell.key) == 16
    assert int(cell.key, 16) >= 0


def test_stored_cell_reads_back(tmp_path):
    for cell in (CELL_0, Cell(FolderSource("a", "b"), tiny_recipe(), Measures(None, 0, False, "w", True))):
        assert read_cell(store_cell(cell, tmp_path)) == cell


@pytest.mark.parametrize("text", ["[]", "{}", '{"source": {"kind": "Other"}}', "{"])
def test_damaged_description_is_a_sentence(tmp_path, text):
    folder = store_cell(CELL_0, tmp_path)
    (folder / CELL).write_text(text)
    with pytest.raises(TwofoldError):
        read_cell(folder)


def test_results_of_other_measures_do_not_count(tmp_path):
    store_results(store_cell(CELL_0, tmp_path))
    assert CELL_0.results(tmp_path) is not None
    assert replace(CELL_0, measures=Measures(max_images=5)).results(tmp_path) is None


def test_failure_is_written_as_a_sentence_and_not_raised(tmp_path):
    cell = stub_cells(1, 13)[0]
    folder = store_cell(cell, tmp_path)
    run_cell(str(folder), None, stub_work)
    assert cell.failure(tmp_path) == "The loss at step 3 is not a finite number."


def test_cell_that_another_process_is_at_is_left_alone(tmp_path):
    folder = store_cell(CELL_0, tmp_path)
    with locked(folder):
        run_cell(str(folder), None, stub_work)
    assert "another process" in CELL_0.failure(tmp_path)
    assert not (folder / RESULTS).exists()


@pytest.fixture(scope="module")
def person_cell(person_folder):
    recipe = replace(tiny_recipe(12), name="tiny")
    return Cell(FolderSource(str(person_folder), folder_digest(person_folder)), recipe, Measures(3, 1))


def test_interrupted_cell_goes_on_and_ends_with_the_same_results(person_cell, tmp_path, monkeypatch):
    whole, parts = (store_cell(person_cell, tmp_path / name) for name in ("whole", "parts"))
    run_cell(str(whole))
    train, stops = loop.train, iter([4, 9])

    def interrupted(capture, recipe, folder, device, resume, watch, before_first):
        stop = next(stops, None)

        def look(progress):
            watch(progress)
            if progress.step == stop:
                raise KeyboardInterrupt

        return train(capture, recipe, folder, device, resume, look, before_first)

    monkeypatch.setattr(loop, "train", interrupted)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            run_cell(str(parts))
        assert not (parts / RESULTS).exists()
        assert not (parts / FAILURE).exists()
        assert (parts / RUN / "recipe.json").exists()
    run_cell(str(parts))
    first, second = (read_json(folder / RESULTS) for folder in (whole, parts))
    for found in (first, second):
        del found["seconds"]
    assert first == second
    assert {"novel_view", "novel_pose", "geometry", "images"} <= set(first)


def test_measuring_anew_trains_nothing(person_cell, tmp_path, monkeypatch):
    run_cell(str(store_cell(person_cell, tmp_path)))
    steps = []
    train = loop.train
    monkeypatch.setattr(
        loop, "train", lambda *words: train(*words[:5], lambda progress: steps.append(progress.step), *words[6:])
    )
    other = replace(person_cell, measures=Measures(1, 0, False))
    run_cell(str(store_cell(other, tmp_path)))
    found = other.results(tmp_path)
    assert found is not None
    assert not steps
    assert len(found["images"]) == 2
    assert found["seconds"]["seconds_per_step"] > 0


def test_a_damaged_true_mesh_is_told_before_the_training(person_cell, tmp_path, monkeypatch):
    def damaged(capture, most):
        raise TwofoldError("a mesh is damaged")

    monkeypatch.setattr(cells, "require_meshes", damaged)
    monkeypatch.setattr(cells.loop, "train", lambda *given: pytest.fail("it trains"))
    folder = store_cell(replace(person_cell, measures=Measures(2, 1, False)), tmp_path)
    run_cell(str(folder))
    assert read_cell(folder).failure(tmp_path) == "a mesh is damaged"
