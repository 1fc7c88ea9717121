"""Storages: what a kill leaves behind in a journal, files of strangers, and passwords that nobody may read."""

import sqlite3
import time
from collections.abc import Callable
from pathlib import Path

import optuna
import pytest
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from typer.testing import CliRunner

from search.cli.main import app
from search.execution import storage as storage_module
from search.execution.passwords import storage_name, without_password
from search.execution.storage import JOURNAL, open_storage
from search.training import provenance


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


def other_version(revision: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        open_storage(f"sqlite:///{path}").create_new_study([optuna.study.StudyDirection.MAXIMIZE], "study")
        with sqlite3.connect(path) as connection:
            connection.execute("UPDATE alembic_version SET version_num = ?", (revision,))

    return write


def table(path: Path) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE history (page TEXT)")


@pytest.mark.parametrize(
    ("where", "write", "message"),
    [
        ("own.log", lambda path: path.write_bytes(b"\x7fELF\x00\xff"), "no journal of Optuna"),
        ("own.log", lambda path: path.write_text("step,return\n1,2\n"), "no journal of Optuna"),
        ("own.log", lambda path: path.write_text('[{"op_code":0}]\n'), "no journal of Optuna"),
        ("own.log", lambda path: path.write_text('{"op_code":99,"worker_id":"w"}\n'), "no journal of Optuna 5"),
        ("own.log", lambda path: path.write_text('{"op_code":0,"worker_id":"w"}\n'), "no journal of Optuna 5"),
        ("own.log", lambda path: path.write_text('{"op_code":5 and so on\n{}\n'), "no journal of Optuna 5"),
        ("own.log", Path.mkdir, "is no file"),
        ("own.csv", lambda path: path.write_text("step,return\n1,2\n"), "neither a folder nor a journal"),
        ("sqlite:///own.db", lambda path: path.write_bytes(b"\x7fELF\x00\xff" * 100), "file is not a database"),
        ("sqlite:///own.db", table, "something else than Optuna's studies: history"),
        ("sqlite:///own.db", other_version("v0.9.0.a"), "optuna storage upgrade"),
        ("sqlite://", Path.touch, "a file that all workers open"),
        ("sqlite:///:memory:", Path.touch, "a file that all workers open"),
        ("sqlite:///file:own.db?uri=true", Path.touch, "a file that all workers open"),
        ("sqlite:///own.db", other_version("v99.0.0.a"), "try updating optuna"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
@pytest.mark.parametrize("create", [True, False], ids=["create", "look"])
def test_what_is_no_storage_is_refused_and_not_touched(
    where: str, write: Callable[[Path], None], message: str, create: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path(where.rpartition("/")[2] or "nothing")
    write(path)
    before = path.is_file() and path.read_bytes()
    with pytest.raises(ValueError, match=message if create or "history" not in message else "no studies") as error:
        open_storage(where, create=create)
    assert where in str(error.value) and "\n" not in str(error.value)
    assert (path.is_file() and path.read_bytes()) == before


@pytest.mark.parametrize("where", ["own.log", "sqlite:///own.db"])
def test_an_empty_file_holds_nothing_to_look_at_but_may_be_filled(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path(where.rpartition("/")[2])
    path.touch()  # a worker that was killed in its first moment
    with pytest.raises(ValueError, match=r"is empty|no studies"):
        open_storage(where, create=False)
    assert path.stat().st_size == 0
    optuna.create_study(study_name="there", storage=open_storage(where))
    assert optuna.get_all_study_names(open_storage(where, create=False)) == ["there"]


def test_a_folder_may_be_called_like_a_database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    open_storage("sqlite-study")
    assert (tmp_path / "sqlite-study" / JOURNAL).exists()


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("postgresql://me:secret@host/db", "postgresql://me:***@host/db"),
        ("to mysql+pymysql://me:sec:ret/1@host, and on", "to mysql+pymysql://me:***@host, and on"),
        ("postgresql:///db?host=h&password=secret&user=me", "postgresql:///db?host=h&password=***&user=me"),
        ("sqlite:///study.db", "sqlite:///study.db"),
        ("redis://:secret@host", "redis://:***@host"),
        ("postgresql:/me:secret@host/db", "postgresql:/me:***@host/db"),
        ("postgresql:me:secret@host/db", "postgresql:me:***@host/db"),
        ("postgresql+psycopg://me:se@cr@et@host/db", "postgresql+psycopg://me:***@host/db"),
        ("postgresql://me:s%40cret%3A@host:5432/db?sslmode=require", "postgresql://me:***@host:5432/db?sslmode=require"),
        ("connect with host=h password=secret user=me", "connect with host=h password=*** user=me"),
        ("password = 'sec ret\\' it' host=h", "password = *** host=h"),
        ("PGPASSWORD=secret aarl", "PGPASSWORD=*** aarl"),
        ("postgresql:/me:secret@host", "postgresql:/me:***@host"),
        ("grpc://127.0.0.1:13000", "grpc://127.0.0.1:13000"),
        ("postgresql://me@corp:secret@host/db", "postgresql://me@corp:***@host/db"),
        ("postgresql://DOMAIN/me:secret@host/db", "postgresql://DOMAIN/me:***@host/db"),
        ("host=h password='a'bcd user=me", "host=h password=*** user=me"),
        ("mssql+pyodbc:///?odbc_connect=UID%3Dme%3BPWD%3Dsecret&x=1", "mssql+pyodbc:///?odbc_connect=***&x=1"),
        ("http://localhost:8080/a@b", "http://localhost:***@b"),  # rather too much
    ],
)
def test_passwords_are_left_out(text: str, shown: str) -> None:
    assert without_password(text) == shown


@pytest.mark.parametrize(
    ("where", "shown"),
    [
        ("postgresql://me:my secret@host/db", "postgresql://me:***@host/db"),
        ("postgresql://me:secret/db", "postgresql://***"),  # no host: what stands for its port is a password
        ("postgresql://me:sec[ret/db", "postgresql://***"),
        ("postgresql://host:5432/db", "postgresql://host:5432/db"),
        ("grpc://host:port", "grpc://host:port"),
        ("runs/a b", "runs/a b"),
        ("--storage=postgresql://me:my secret@host/db", "--storage=postgresql://me:***@host/db"),
    ],
)
def test_a_storage_is_named_without_its_password(where: str, shown: str) -> None:
    assert storage_name(where) == shown


@pytest.mark.parametrize("where", ["postgresql://me:my s3cret@host/db", "postgresql://me:s3cret/db"])
def test_a_password_in_a_url_with_an_error_is_not_shown(where: str, tmp_path: Path) -> None:
    (tmp_path / "a.yml").write_text("environment: Pendulum-v1\nhyperparameters: h.yml\ncheckpoints: [40]\n")
    (tmp_path / "h.yml").write_text("default: {policy: MlpPolicy}\n")
    for command in (["search", str(tmp_path / "a.yml"), "--folder", str(tmp_path / "run")], ["worker"]):
        result = CliRunner().invoke(app, [*command, "--storage", where])
        assert result.exit_code != 0 and "malformed URL" in result.output
        assert "s3cret" not in result.output


@pytest.mark.parametrize("program", ["/bin/aarl", "/work/search/cli/main.py"])
def test_the_command_in_notes_and_reports_has_no_password(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    arguments = ["search", "a.yml", "--storage", "postgresql://me:se cret@host/db"]
    monkeypatch.setattr("sys.argv", [program, *arguments])
    assert provenance.provenance()["command"] == "aarl search a.yml --storage postgresql://me:***@host/db"


class Clock:
    """Time that goes on when it is told to."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.mark.parametrize(
    ("interval", "look_every", "seconds"),
    [(60, 1.0, 120), (60, 59.0, 236), (1, 0.4, 2), (1, 1.02, 5.1), (2, 5.0, 25), (5, 9.0, 45)],
)
def test_a_sign_that_does_not_change_is_noticed_however_slowly_this_process_looks(
    interval: float, look_every: float, seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    monkeypatch.setattr(storage_module, "time", clock)
    watch, began = storage_module._Watch(interval), clock.now
    while watch.unchanged(lambda: {1: "sign"}).get(1, ("sign", 0.0))[1] < 2 * interval:
        clock.now += look_every
        assert clock.now - began < 10 * seconds
    assert clock.now - began <= seconds + look_every


@pytest.mark.parametrize(("interval", "away"), [(60, 61.0), (60, 600.0), (1, 11.0)])
def test_after_a_time_in_which_nobody_looked_watching_begins_anew(
    interval: float, away: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    monkeypatch.setattr(storage_module, "time", clock)
    watch = storage_module._Watch(interval)
    for _ in range(3):
        watch.unchanged(lambda: {1: "sign"})
        clock.now += 0.4 * interval
    assert watch.unchanged(lambda: {1: "sign"})[1][1] > interval
    clock.now += away
    assert watch.unchanged(lambda: {1: "sign"}) == {1: ("sign", 0.0)}


def test_a_plain_journal_of_optuna_and_ours_write_one_file(tmp_path: Path) -> None:
    """A notebook, or the dashboard of somebody who knows nothing of this package."""
    ours = optuna.create_study(study_name="study", storage=open_storage(tmp_path))
    plain = optuna.load_study(study_name="study", storage=JournalStorage(JournalFileBackend(str(tmp_path / JOURNAL))))
    began = time.monotonic()
    for number in range(10):
        for study in (ours, plain):
            study.tell(study.ask(), number)
    assert time.monotonic() - began < 10  # Optuna's own lock would wait 30 seconds for a file that it takes for a lock
    for study in (ours, plain):
        assert [trial.value for trial in study.trials] == [number for number in range(10) for _ in range(2)]
