"""Where a study is: in folders of any name, driven by one program."""

from pathlib import Path

import optuna
import pytest
from optuna.storages import RDBStorage
from postgres import Postgres
from sb3_aarl.search.execution.storage import driver_lock, has_driver, load_study, open_storage


@pytest.mark.parametrize("name", ["with space", "100%", "feature%2Fx", "50%25", "better?", "a?timeout=1", "{x}", "#1", "é"])
def test_a_folder_may_have_any_name(name: str, tmp_path: Path) -> None:
    optuna.create_study(storage=open_storage(tmp_path / name), study_name="mine")
    assert load_study(open_storage(tmp_path / name, create=False)).study_name == "mine"
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [tmp_path / name / "study.db"]


def refused(storage: RDBStorage, study_name: str, folder: Path) -> bool:
    """Whether another driver holds the lock."""
    try:
        with driver_lock(storage, study_name, folder):
            return False
    except ValueError as error:
        assert "another program runs this search" in str(error)
        return True


@pytest.mark.parametrize("database", ["sqlite", "postgresql"])
def test_a_study_has_one_driver_in_whichever_folder(
    database: str, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    urls = ["sqlite:///all.db", f"sqlite:///file:{tmp_path}/all.db?uri=true"]
    if database == "postgresql":
        postgres: Postgres = request.getfixturevalue("postgres")
        urls = [postgres.create("driven")] * 2
    first, second = (open_storage(None, url) for url in urls)
    for name in ("mine", "other"):
        optuna.create_study(storage=first, study_name=name)
    with driver_lock(first, "mine", Path("a")):
        assert refused(second, "mine", Path("b")) and has_driver(second, "mine", Path("b"))
        assert refused(second, "other", Path("a"))
        assert not refused(second, "other", Path("b")) and not has_driver(second, "other", Path("b"))
    assert not refused(second, "mine", Path("b")) and not has_driver(second, "mine", Path("b"))
