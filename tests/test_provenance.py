"""With what results were made."""

import subprocess

import pytest

from twofold import __version__, provenance


@pytest.fixture
def clone(tmp_path):
    """A repository with a package in it, and what git is asked."""
    package = tmp_path / "src" / "twofold"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")

    def git(*words):
        who = ("-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false")
        call = subprocess.run(("git", *who, *words), cwd=tmp_path, capture_output=True, text=True, check=True)
        return call.stdout.strip()

    git("init")
    return package, git


def test_a_clone_is_known_by_its_commit_and_changed_sources_by_a_plus(clone):
    package, git = clone
    git("add", "-A")
    git("commit", "-m", "x")
    head = git("rev-parse", "--short=7", "HEAD")
    assert provenance.commit(package) == head
    (package.parents[1] / "notes.txt").write_text("beside the sources")
    provenance.commit.cache_clear()
    assert provenance.commit(package) == head
    (package / "new.py").write_text("")
    # What this process imported does not change any more.
    assert provenance.commit(package) == head
    provenance.commit.cache_clear()
    assert provenance.commit(package) == head + "+"


def test_where_git_cannot_compare_the_sources_the_commit_is_kept_with_a_question_mark(clone, monkeypatch):
    package, git = clone
    git("add", "-A")
    git("commit", "-m", "x")
    told = provenance._told
    monkeypatch.setattr(provenance, "_told", lambda at, *words: None if words[0] == "status" else told(at, *words))
    assert provenance.commit(package) == git("rev-parse", "--short=7", "HEAD") + "?"


def test_a_package_installed_inside_of_another_repository_has_no_commit(clone):
    package, git = clone
    (package.parents[1] / "other.txt").write_text("")
    git("add", "other.txt")
    git("commit", "-m", "x")
    assert provenance.commit(package) is None


def test_without_git_there_is_no_commit(clone, monkeypatch):
    package, git = clone
    git("add", "-A")
    git("commit", "-m", "x")
    monkeypatch.setenv("PATH", "")
    assert provenance.commit(package) is None


@pytest.mark.parametrize("head", [None, "f22924d"])
def test_versions_and_the_commit_are_told(head, monkeypatch):
    monkeypatch.setattr(provenance, "commit", lambda: head)
    told = provenance.made_with()
    assert told["twofold"] == __version__
    assert told["packages"]["torch"].startswith("2.")
    assert told.get("commit") == head
    assert provenance.program(told) == (f"{__version__} at f22924d" if head else __version__)
