"""optuna-dashboard for searches: what stands in the notes, the evolution plot, and the server."""

import io
import json
import math
import re
import tempfile
import textwrap
import uuid
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from optuna import Study
from optuna.artifacts import FileSystemArtifactStore, upload_artifact
from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial, TrialState
from optuna_dashboard import run_server, save_note, save_plotly_graph_object
from optuna_dashboard._note import get_note_from_system_attrs
from optuna_dashboard.artifact import get_artifact_path

from sb3_aarl.aux_loss import AuxLoss
from search.results.notation import subscripts
from search.results.plots import evolution_figure, learning_curve_png
from search.results.trials import curve_of, lineage, loss_of, operation_of, parents_of, score_of, stage_of, trained_loss_of

ARTIFACTS = "artifacts"  # folder of the pictures in notes
PLOT_ID = "evolution"
# Notes live in the attributes of the study, of which every worker and every page of the dashboard reads all.
MAX_ANCESTORS = 12
MAX_CURVE_ROWS = 20
MAX_TEXT = 300
BEGUN = "**State:** begun"

HOW_TO_READ_SEARCH = """\
- Each **trial** trains one candidate: an auxiliary loss `{source} -> {target}`, from which tokens of a window of \
experience which others are predicted. Its value is the area under its learning curve, its note says what it is.
- **Stages**: the best quarter of a stage are the parents of the next. The trials' user attributes `stage`, \
`operation` and `parents` tell where a candidate comes from.
- The plot **evolution** shows the scores of all candidates by stage. The parameters are one boolean for every token, \
so that their importances are the tokens'."""

HOW_TO_READ_RUNS = """\
Each **trial** is one training of a list that was given: its user attributes `variant`, `environment` and `seed` tell \
which. Its value is the area under its learning curve. Nothing is searched here, so trials have no parameters."""


def artifacts(folder: Path) -> FileSystemArtifactStore:
    """
    Where the pictures of a run's folder are.

    :param folder: Folder of the run, made if it is not there
    """
    path = folder / ARTIFACTS
    path.mkdir(parents=True, exist_ok=True)
    return FileSystemArtifactStore(path)


def annotate_study(study: Study, settings: Mapping[str, Any], provenance: Mapping[str, Any], is_search: bool = True) -> None:
    """
    Write the study's note: what is searched, with which settings, on which commit, and how to read it.

    :param study: The study
    :param settings: Names and values of its settings
    :param provenance: As ``search.training.provenance.provenance`` gives it
    :param is_search: False for a list of given runs
    """
    title = "Search for auxiliary losses" if is_search else "Trainings"
    note = [f"## {title}: {_escape(study.study_name)}", HOW_TO_READ_SEARCH if is_search else HOW_TO_READ_RUNS]
    for heading, values in (("Settings", settings), ("Where it comes from", provenance)):
        rows = [(_escape(name), _escape(value)) for name, value in values.items()]
        note += [f"### {heading}", _table(("name", "value"), rows)]
    save_note(study, "\n\n".join(note))


def annotate_trial(study: Study, trial: FrozenTrial | int, artifact_store: FileSystemArtifactStore | None = None) -> None:
    """
    Write the note of a trial: its loss, where it comes from, and its learning curve.

    It may be written again, while the trial runs (its curve then grows) and after it.

    :param study: The study
    :param trial: The trial, or its number
    :param artifact_store: Where the picture of the learning curve goes; None for the table alone
    """
    trials = study.get_trials(deepcopy=False)
    trial = trials[trial if isinstance(trial, int) else trial.number]
    # Until all seeds are done there is what was reported of the first.
    reported = [(step, mean, math.nan) for step, mean in sorted(trial.intermediate_values.items())]
    loss, curve = trained_loss_of(trial), curve_of(trial) or reported
    note = [*_loss_lines(trial, loss), _origin(trial)]
    if "reason" in trial.user_attrs:
        note.append(f"**Reason:** {_escape(trial.user_attrs['reason'])}")
    if curve:
        # The last evaluation is always among the rows.
        shown = curve[:: -len(curve) // MAX_CURVE_ROWS]
        rows = [(step, f"{mean:.1f}", "-" if math.isnan(std) else f"{std:.1f}") for step, mean, std in shown]
        note += ["#### Learning curve", _table(("environment steps", "mean", "std"), rows[::-1])]
        if artifact_store is not None:
            note.append(f"![Learning curve]({_picture(study, trial, loss, curve, artifact_store)})")
    if ancestors := lineage(trial, trials):
        nearest = sorted(ancestors[:MAX_ANCESTORS], key=lambda ancestor: -ancestor.number)
        note += ["#### Lineage", _table(("trial", "stage", "from", "score", "loss"), [_ancestor(other) for other in nearest])]
        if len(ancestors) > len(nearest):
            note.append(f"… and {len(ancestors) - len(nearest)} more ancestors.")
    save_note(_noted(study, trial), "\n\n".join(note))


def annotate_ended(study: Study, artifact_store: FileSystemArtifactStore) -> None:
    """
    Write the notes of failed trials again that still say that they run: their workers died, or were interrupted.

    :param study: The study
    :param artifact_store: As for :func:`annotate_trial`
    """
    attrs = study._storage.get_study_system_attrs(study._study_id)
    for trial in study.get_trials(deepcopy=False, states=(TrialState.FAIL,)):
        if BEGUN in get_note_from_system_attrs(attrs, trial._trial_id)["body"]:
            annotate_trial(study, trial, artifact_store)


def update_plots(study: Study, baselines: Iterable[tuple[str, float]] = ()) -> None:
    """
    Write or replace the evolution plot of the study. It holds every candidate: once a stage is often enough.

    :param study: The study
    :param baselines: Names and scores of horizontal lines
    """
    figure = evolution_figure(study.get_trials(deepcopy=False), baselines, study.direction)
    save_plotly_graph_object(study, figure, graph_object_id=PLOT_ID)


def serve(storage: BaseStorage, artifact_path: str | Path, host: str = "127.0.0.1", port: int = 8080) -> None:
    """
    Serve optuna-dashboard until it is interrupted. Whoever reaches it can change and delete studies.

    :param storage: The storage of the studies
    :param artifact_path: Folder of the artifact store, made if it is not there
    :param host: Address to listen on; by default this machine's own, which no other machine reaches
    :param port: Port to listen on
    """
    Path(artifact_path).mkdir(parents=True, exist_ok=True)
    run_server(storage, host=host, port=port, artifact_store=FileSystemArtifactStore(artifact_path))


def _loss_lines(trial: FrozenTrial, loss: AuxLoss | None) -> list[str]:
    # The dashboard shows no HTML in notes, unless it is told to trust all of them with scripts: no MathML there.
    if loss is None and "variant" in trial.user_attrs:
        none = ["No auxiliary loss."] if trial.user_attrs.get("loss") == "none" else []
        return [f"### {_escape(trial.user_attrs['variant'])}", *none]
    if loss is None:
        return [f"### Trial {trial.number}", "It has no valid loss."]
    canonical = f"Canonical: `{loss.canonical()}`" if loss.canonical() != loss else "This is its canonical form."
    latex = "\n".join(_wrap(loss.latex(), 80))
    return [f"### {subscripts(loss)}", f"```latex\n{latex}\n```", f"Notation: `{loss}`", canonical]


def _wrap(latex: str, width: int) -> list[str]:
    return textwrap.wrap(latex, width, break_long_words=False, break_on_hyphens=False)


def _origin(trial: FrozenTrial) -> str:
    score, parents = score_of(trial), parents_of(trial)
    ended = f"**Score:** {score:.2f}" if score is not None else f"**State:** {trial.state.name.lower()}"
    text = ended if trial.state.is_finished() else BEGUN
    if "variant" in trial.user_attrs:
        cell = {name: trial.user_attrs.get(name) for name in ("variant", "environment", "seed")}
        return text + "".join(f". **{name.capitalize()}:** {_escape(value)}" for name, value in cell.items()) + "."
    text += f". **Stage:** {stage_of(trial)}. **Operation:** {_escape(operation_of(trial))}"
    return text + (f" of trial {' and trial '.join(map(str, parents))}." if parents else ".")


def _ancestor(trial: FrozenTrial) -> tuple[Any, ...]:
    score, loss = score_of(trial), loss_of(trial)
    origin = _escape(" ".join([operation_of(trial), *map(str, parents_of(trial))]))
    notation = f"`{textwrap.shorten(str(loss), 100, placeholder=' …')}`" if loss else "-"
    return trial.number, stage_of(trial), origin, "-" if score is None else f"{score:.1f}", notation


def _picture(
    study: Study,
    trial: FrozenTrial,
    loss: AuxLoss | None,
    curve: Sequence[tuple[int, float, float]],
    store: FileSystemArtifactStore,
) -> str:
    """The path of the curve's picture on the server; it is drawn once for each length of the curve."""
    storage, name = study._storage, f"learning-curve-{curve[-1][0]}.png"
    # The dashboard knows two places: attributes of the trial, where Optuna writes, and of the study, because those of
    # a finished trial cannot be changed.
    study_prefix = f"dashboard:artifacts:{trial._trial_id}:"
    known = {key: value for key, value in trial.system_attrs.items() if key.startswith("artifacts:")}
    study_attrs = dict(storage.get_study_system_attrs(study._study_id))
    known |= {key: value for key, value in study_attrs.items() if key.startswith(study_prefix)}
    for value in known.values():
        meta = json.loads(value)
        if meta is not None and meta["filename"] == name:  # None: deleted in the dashboard
            return get_artifact_path(_noted(study, trial), meta["artifact_id"])

    typeset = [f"${line}$" for line in _wrap(loss.latex(), 130)] if loss else []
    title = "\n".join([f"Trial {trial.number}", *typeset])
    picture = learning_curve_png(curve, title)
    if trial.state.is_finished():
        artifact_id = str(uuid.uuid4())
        meta = {"artifact_id": artifact_id, "filename": name, "mimetype": "image/png", "encoding": None}
        store.write(artifact_id, io.BytesIO(picture))
        storage.set_study_system_attr(study._study_id, study_prefix + artifact_id, json.dumps(meta))
    else:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, name)
            path.write_bytes(picture)
            artifact_id = upload_artifact(artifact_store=store, file_path=str(path), study_or_trial=trial, storage=storage)
    return get_artifact_path(_noted(study, trial), artifact_id)


def _noted(study: Study, trial: FrozenTrial) -> Any:
    """What optuna-dashboard's functions read of a Trial, which cannot be had of a finished one."""
    return SimpleNamespace(storage=study._storage, study=study, _trial_id=trial._trial_id)


def _escape(text: object) -> str:
    """Text as it is, whatever Markdown or HTML would make of it: one line, of bounded length."""
    line = " ".join(str(text).split())
    line = line if len(line) <= MAX_TEXT else line[:MAX_TEXT] + "…"
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", line)


def _table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)
