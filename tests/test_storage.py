"""Storages: what a kill leaves behind in a journal, and passwords that nobody may read."""

from pathlib import Path

import optuna
import pytest

from search import provenance
from search.storage import JOURNAL, open_storage, without_password


@pytest.mark.parametrize("kept", [1, 40, -1], ids=str)
def test_a_line_that_was_cut_short_does_not_spoil_the_journal(tmp_path: Path, kept: int) -> None:
    study = optuna.create_study(study_name="cut", storage=open_storage(tmp_path))
    study.set_user_attr("before", 1)
    journal = tmp_path / JOURNAL
    whole = journal.read_bytes()
    study.set_user_attr("lost", "x" * 100)
    journal.write_bytes(whole + journal.read_bytes()[len(whole) :][:kept])

    for _ in range(2):  # by one process that begins after the kill, and by another one
        later = optuna.load_study(study_name="cut", storage=open_storage(tmp_path, create=False))
        assert "lost" not in later.user_attrs
        later.set_user_attr("after", later.user_attrs.get("after", 0) + 1)
    assert optuna.load_study(study_name="cut", storage=open_storage(tmp_path)).user_attrs == {"before": 1, "after": 2}
    assert journal.read_bytes().startswith(whole)


@pytest.mark.parametrize("where", ["runs", "sqlite:///study.db", "sqlite+pysqlite:///study.db", "other.log"])
def test_looking_makes_no_storage(where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="does not exist"):
        open_storage(where, create=False)
    assert not list(tmp_path.iterdir())
    optuna.create_study(study_name="there", storage=open_storage(where))
    assert optuna.get_all_study_names(open_storage(where, create=False)) == ["there"]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("postgresql://me:secret@host/db", "postgresql://me:***@host/db"),
        ("to mysql+pymysql://me:sec:ret/1@host, and on", "to mysql+pymysql://me:***@host, and on"),
        ("postgresql:///db?host=h&password=secret&user=me", "postgresql:///db?host=h&password=***&user=me"),
        ("sqlite:///study.db", "sqlite:///study.db"),
        ("redis://:secret@host", "redis://:***@host"),
        ("http://localhost:8080/a@b", "http://localhost:***@b"),  # rather too much
    ],
)
def test_passwords_are_left_out(text: str, shown: str) -> None:
    assert without_password(text) == shown


def test_the_command_in_notes_and_reports_has_no_password(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["/bin/aarl", "search", "a.yml", "--storage", "postgresql://me:secret@host/db"])
    assert provenance.provenance()["command"] == "aarl search a.yml --storage postgresql://me:***@host/db"
