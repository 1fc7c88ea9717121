"""The evolution (paper, sections 2.2 and 3): a study that worker processes of one machine or many fill stage by stage."""

import contextlib
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple

import optuna
import yaml
from optuna.study._frozen import FrozenStudy
from optuna.trial import FrozenTrial, TrialState

from sb3_aarl.aux_loss import AuxLoss
from sb3_aarl.callbacks import replace_text
from search.evolution.sampler import AuxLossSampler, SearchComplete, StageProgress
from search.execution import matrix as grid
from search.execution import workers
from search.execution.local import Pool, Unfit, WorkerError, uninterrupted
from search.execution.storage import HEARTBEAT_INTERVAL, PATIENCE, Outlasting, ServerLost, load_study, open_storage
from search.results.dashboard import annotate_ended, annotate_study, annotate_trial, artifacts, update_plots
from search.results.trials import loss_of, ranked
from search.studies.objective import CandidateFailed, DiskError, Objective, causes, check_study, disk_problem, make_pruner
from search.training.config import SearchConfig, dump, load_config
from search.training.provenance import provenance
from search.training.run import DeviceError, check_actions

logger = logging.getLogger(__name__)

# Candidates that may fail one after the other in one worker: then it is not the losses that are at fault.
MAX_FAILURES = 10
# Seconds between two looks at the storage, by a worker without a place and by the live table.
POLL_SECONDS = 1.0
# Seconds between two drawings of the evolution: each stays in the storage, a hundred kilobytes for a whole search.
PLOT_SECONDS = 300.0
# Seconds between two looks for a search that has not been begun.
WAIT_SECONDS = 10.0
# User attribute of a study: its configuration and file of hyper-parameters as text, for workers of other machines.
CONFIG_KEY = "config"

# Starts workers that run a function with its arguments: a pool with its number of processes, threads and so on.
Launch = Callable[[Callable[..., None], tuple[Any, ...]], Pool]


class Progress(NamedTuple):
    """
    :param stages: How far each stage is
    :param best: Best score so far, None before the first
    :param best_loss: Notation of its loss
    :param seconds_to_go: Estimate, None before the first candidate is done
    """

    stages: list[StageProgress]
    best: float | None
    best_loss: str | None
    seconds_to_go: float | None


def settings(config: SearchConfig) -> dict[str, Any]:
    """What a note or a report says of the settings: the hyper-parameters written out, in plain values."""
    hidden = ("path", "overrides", "hyperparameters", "cross_validation", "operator_selection", "baselines")
    shown = {item.name: getattr(config, item.name) for item in fields(config) if item.name not in hidden}
    return {**shown, **config.hyperparameters_for(config.environment)}


def baselines(config: SearchConfig) -> grid.Grid:
    """
    The trainings that candidates are compared with, on the search's environment and seeds.

    :param config: The search
    """
    variants = {baseline.name: grid.Variant(baseline.aux_loss, baseline.overrides) for baseline in config.baselines}
    return grid.Grid(f"{config.name}-baselines", config, variants, [config.environment], config.seeds)


def baseline_scores(config: SearchConfig, storage: optuna.storages.BaseStorage) -> list[tuple[str, float]]:
    """
    Name and mean score of the baselines that are trained.

    :param config: The search
    :param storage: Its storage
    """
    name = baselines(config).name
    if name not in optuna.get_all_study_names(storage):
        return []
    scores = grid.scores(optuna.load_study(study_name=name, storage=storage), baselines(config).cells)
    return [(str(name), float(score)) for name, score in scores.groupby("variant")["score"].mean().items()]


def keep_config(study: optuna.Study, config: SearchConfig) -> None:
    """
    Leave a configuration in its study, so that a worker needs the storage only.

    :param study: The study
    :param config: The search
    :raises ValueError: when the study was to have more stages, for which others may wait, or has candidates of another seed
    """
    hidden = {"path": None, "hyperparameters": f"{config.name}-hyperparameters.yml"}
    values = {item.name: hidden.get(item.name, getattr(config, item.name)) for item in fields(config)}
    texts = {
        f"{config.name}.yml": dump(_plain({key: value for key, value in values.items() if value is not None})),
        hidden["hyperparameters"]: config.hyperparameters.read_text(encoding="utf-8"),
    }
    stored, stages, seed = study.user_attrs.get(CONFIG_KEY), 0, config.seed
    with contextlib.suppress(yaml.YAMLError, LookupError, TypeError, ValueError):  # one of another kind is replaced
        begun = yaml.safe_load((stored or {})[f"{config.name}.yml"])
        stages, seed = int(begun["stages"]), int(begun["seed"])
    if stages > config.stages:
        raise ValueError(f"study {config.name!r} was begun with {stages} stages: it may get more, not {config.stages}")
    if seed != config.seed and study.get_trials(deepcopy=False):
        raise ValueError(f"study {config.name!r} was begun with seed={seed}, which it keeps: not {config.seed}")
    if stored != texts:
        study.set_user_attr(CONFIG_KEY, texts)


def is_search(study: optuna.Study | FrozenStudy) -> bool:
    """
    Whether a study has the configuration of a search, and not something else under that name.

    :param study: The study
    """
    name, texts = study.study_name, study.user_attrs.get(CONFIG_KEY)
    expected = {f"{name}.yml", f"{name}-hyperparameters.yml"}
    is_text = isinstance(texts, dict) and texts.keys() == expected and all(isinstance(text, str) for text in texts.values())
    return is_text and len(study.directions) == 1


def stored_config(study: optuna.Study, folder: Path) -> SearchConfig:
    """
    The configuration that :func:`keep_config` left in a study, checked like any other.

    :param study: The study
    :param folder: Folder of the search; the configuration's files are written into its folder ``config``
    :raises ValueError: when the study has none, or one that cannot be used
    """
    name, texts = study.study_name, study.user_attrs.get(CONFIG_KEY)
    if texts is None:
        raise ValueError(f"study {name!r} has no configuration: begin it, or go on with it, with aarl search")
    if not is_search(study) or Path(name).name != name or name == "..":
        raise ValueError(f"study {name!r} has a configuration of another kind")
    folder = folder / "config"
    for file, text in texts.items():
        replace_text(folder / file, text)  # other workers may be reading it
    return load_config(folder / f"{name}.yml")


def _plain(value: Any) -> Any:
    """What YAML can say of a setting."""
    if isinstance(value, AuxLoss):
        return str(value)
    if is_dataclass(value):
        value = {item.name: getattr(value, item.name) for item in fields(value)}
        return {key: "none" if key == "aux_loss" and item is None else _plain(item) for key, item in value.items()}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def run_worker(name: str, folder: Path, where: str, heartbeat: int) -> None:
    """
    Train candidates until the search is complete; any number of processes on any machines may do so.

    :param name: The search's study, which has its configuration
    :param folder: Folder of the search, for checkpoints and curves
    :param where: Its storage, as for ``open_storage``
    :param heartbeat: Seconds between two signs of life
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)  # it shows a failed trial with all of its traceback
    storage = open_storage(where, create=False, patience=PATIENCE, heartbeat_interval=heartbeat)
    config = stored_config(load_study(storage, name), folder)
    sampler = AuxLossSampler(**config.sampler_settings())
    study = optuna.load_study(study_name=name, storage=storage, sampler=sampler, pruner=make_pruner(config))
    pictures = artifacts(folder)
    failures = 0
    current: int | None = None

    def begun(trial: optuna.Trial) -> None:
        nonlocal current
        current = trial.number
        annotate_trial(study, current, pictures)

    objective = Objective(config, folder / "candidates", on_begin=begun)

    def finished(study: optuna.Study, trial: FrozenTrial) -> None:
        nonlocal current, failures
        current = None
        with uninterrupted():
            annotate_trial(study, trial, pictures)
        reason = trial.user_attrs.get("reason")
        if trial.state != TrialState.FAIL:
            failures = 0
            return
        failures += not trial.user_attrs.get(workers.DIED_KEY)  # the same one goes on, ``retries`` times
        if reason is not None:
            logger.warning("Trial %d failed: %s", trial.number, reason)
        if failures == MAX_FAILURES:
            raise ValueError(f"{failures} candidates failed one after the other, the last one: {reason}")

    while True:
        try:
            # One that died before it gave its name keeps a place from the others, who leave it one.
            running = study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
            workers.fail_dead(study, running, all_have_names=True)
            # Without this look a worker too many would leave a trial behind that never got a place.
            if sampler.has_place(study):
                # Models lie in reference cycles: the next candidate needs their memory.
                study.optimize(objective, n_trials=1, catch=(CandidateFailed,), callbacks=[finished], gc_after_trial=True)
            else:
                time.sleep(POLL_SECONDS)
        except SearchComplete:
            return
        except KeyboardInterrupt:
            if current is not None:  # Optuna calls nobody back then
                if isinstance(storage, Outlasting):
                    storage.patience = 0.0  # a server that is away must not keep a worker that is to end
                with uninterrupted(), contextlib.suppress(Exception):  # it is an interruption, whatever becomes of the note
                    annotate_trial(study, current, pictures)
            raise
        except Exception as error:
            # A laptop that slept: others took this worker for dead and failed its trial, whose place they give out again.
            if workers.was_failed(error):
                logger.warning("A trial of this worker was failed by another one meanwhile: %s", error)
                continue
            for cause in causes(error):
                if isinstance(cause, ServerLost):  # Optuna stumbles over what follows from it
                    raise cause from None
                if isinstance(cause, DeviceError):
                    raise Unfit(str(cause)) from None
            with _explained(study, name, folder):
                raise


@contextlib.contextmanager
def _explained(study: optuna.Study, name: str, folder: Path) -> Iterator[None]:
    """Say what is behind errors that a user can mend: a full disk, a study that somebody deleted."""
    try:
        yield
    except WorkerError:  # it is explained
        raise
    except Exception as error:
        if problem := disk_problem(error, folder):
            raise DiskError(problem) from None
        is_key = any(isinstance(cause, KeyError) for cause in causes(error))
        if is_key and name not in optuna.get_all_study_names(study._storage):
            raise ValueError(f"study {name!r} was deleted from its storage") from None
        raise


def search(
    config: SearchConfig, folder: Path, where: str, launch: Launch | None, heartbeat: int = HEARTBEAT_INTERVAL
) -> Iterator[Progress]:
    """
    Run a search, or go on with it: all that it knows is in the storage.

    Yields about once a second. Ctrl-C, or leaving the loop, interrupts the workers.

    :param config: The search
    :param folder: Its folder
    :param where: Its storage, as for ``open_storage``
    :param launch: Starts the workers; None to begin the study and to watch workers that are started elsewhere
    :param heartbeat: Seconds between two signs of life of a worker; one of another machine that has given none for twice as
        long has died
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    check_actions(config.environment)
    storage = open_storage(where)
    sampler = AuxLossSampler(**config.sampler_settings())
    study = optuna.create_study(
        study_name=config.name, storage=storage, sampler=sampler, direction="maximize", load_if_exists=True
    )
    check_study(study, config)
    of_all = {"environment": config.environment, "seeds": config.seeds}
    grid.check_training(study, {"candidates": of_all | grid.training(config, config.environment)})
    progress = look(study, sampler)  # refuses a study that was begun with other settings of the sampler
    keep_config(study, config)
    annotate_study(study, settings(config), provenance())
    yield progress
    yield from _drawn(_fill(study, sampler, launch, folder, where, heartbeat), study, config, folder)


def join(
    where: str,
    name: str | None,
    folder: Path | None,
    launch: Launch,
    heartbeat: int = HEARTBEAT_INTERVAL,
    wait: float = 0.0,
) -> Iterator[Progress]:
    """
    Work on a search that another program began, on this machine or another one, until it is complete.

    :param where: Its storage, as for ``open_storage``
    :param name: Its study, None for the only search there
    :param folder: Folder of the search, None for ``runs/NAME``. Where machines share it, candidates of a worker that died
        go on from its checkpoints; else they begin anew
    :param launch: Starts the workers
    :param heartbeat: As for :func:`search`
    :param wait: Seconds to wait for the search to be begun
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    deadline = time.monotonic() + wait
    while True:
        try:
            storage = open_storage(where, create=False)
            searches = [study.study_name for study in storage.get_all_studies() if is_search(study)]
            study = load_study(storage, searches[0] if name is None and len(searches) == 1 else name)
            if CONFIG_KEY in study.user_attrs or time.monotonic() > deadline:
                break
            problem: object = "it has no configuration yet"
        except ValueError as error:
            if time.monotonic() > deadline:
                raise
            problem = error
        logger.warning("Waiting for the search to be begun: %s", problem)
        time.sleep(min(WAIT_SECONDS, max(0.0, deadline - time.monotonic())))
    folder = folder or Path("runs") / study.study_name
    config = stored_config(study, folder)
    check_study(study, config)
    sampler = AuxLossSampler(**config.sampler_settings())
    yield look(study, sampler)
    yield from _drawn(_fill(study, sampler, launch, folder, where, heartbeat), study, config, folder)


def _drawn(progresses: Iterator[Progress], study: optuna.Study, config: SearchConfig, folder: Path) -> Iterator[Progress]:
    """Draw the evolution now and then, and at the end; what dead workers could not note likewise."""
    ended, drawn = -1, -math.inf

    def draw() -> None:
        update_plots(study, baseline_scores(config, study._storage))
        annotate_ended(study, artifacts(folder))

    with _explained(study, config.name, folder):
        for progress in progresses:
            if _ended(progress) != ended and time.monotonic() - drawn > PLOT_SECONDS:
                draw()
                ended, drawn = _ended(progress), time.monotonic()
            yield progress
        draw()


def _fill(
    study: optuna.Study, sampler: AuxLossSampler, launch: Launch | None, folder: Path, where: str, heartbeat: int
) -> Iterator[Progress]:
    """Let workers fill the places that are left; with none here, wait for those elsewhere."""
    where = where if "://" in where else str(Path(where).absolute())
    target = run_worker, (study.study_name, folder.absolute(), where, heartbeat)
    with contextlib.nullcontext() if launch is None else launch(*target) as pool:
        before, progress, busy = -1, look(study, sampler), True
        while busy:
            time.sleep(POLL_SECONDS)
            ended = _ended(progress)
            busy = pool is None or pool.check(progressed=ended != before)
            before, progress = ended, look(study, sampler)
            if pool is None:
                busy = any(stage.filled < stage.places for stage in progress.stages)
            yield progress


def _ended(progress: Progress) -> int:
    """How many trials have ended, other than by a death."""
    return sum(stage.filled + stage.failed - stage.died for stage in progress.stages)


def look(study: optuna.Study, sampler: AuxLossSampler) -> Progress:
    """
    How far a search is.

    :param study: The study
    :param sampler: Its sampler
    """
    stages = sampler.progress(study)
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    best = next(iter(ranked(complete, study.direction)), None)
    durations = [trial.duration.total_seconds() for trial in complete if trial.duration is not None]
    left = sum(stage.places - stage.filled for stage in stages)
    n_workers = max(1, sum(stage.running for stage in stages))
    return Progress(
        stages,
        None if best is None else best.value,
        None if best is None else str(loss_of(best)),
        sum(durations) / len(durations) * left / n_workers if durations else None,
    )
