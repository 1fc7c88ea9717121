"""A training that is killed goes on bit for bit; checkpoints that others wrote are not unpickled; full disks lose nothing."""

import base64
import errno
import json
import logging
import multiprocessing
import os
import pickle
import resource
import shutil
import signal
import stat
import subprocess
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_aarl import SACAux
from sb3_aarl.callbacks import Evaluation, read_curve
from search.training import checkpoint
from search.training import run as training
from search.training.checkpoint import CheckpointError, opened, seal, user_key
from search.training.run import train_candidate

LOSS = "{s_t, a_t} -> {s_t+1}"
STEPS = 150
HYPER: dict[str, Any] = {
    "env_kwargs": {},
    "buffer_size": 1000,
    "learning_starts": 20,
    "batch_size": 32,
    "predictor_width": 16,
    "policy_kwargs": {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 8, "width": 8}},
    "device": "cpu",
}
# Episodes of 50, 125 and 200 agent steps; a checkpoint every 30.
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "reacher": ("dm_control/reacher-easy-v0", {"env_kwargs": {"action_repeat": 20}}),
    "two-cheetahs": ("dm_control/cheetah-run-v0", {"env_kwargs": {"action_repeat": 8}, "n_envs": 2, "gradient_steps": -1}),
    "pendulum": ("Pendulum-v1", {"env_kwargs": {"frame_stack": 2}}),
}


@pytest.fixture(autouse=True, scope="module")
def key(tmp_path_factory: pytest.TempPathFactory) -> Iterator[bytes]:
    """A key for these tests, instead of the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(checkpoint.KEY_VARIABLE, str(tmp_path_factory.mktemp("user") / "key"))
        made = user_key()
        assert made is not None
        yield made


@pytest.fixture(scope="module")
def processes() -> multiprocessing.context.ForkServerContext:
    """Processes that begin with everything imported."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["search.training.run", "torch._dynamo"])  # which the first optimizer imports
    return context


def arguments_of(case: str, folder: Path, **changes: Any) -> dict[str, Any]:
    environment, hyper = CASES[case]
    repeat = hyper["env_kwargs"].get("action_repeat", 1)
    return {
        "environment": environment,
        "aux_loss": LOSS,
        "hyperparameters": HYPER | hyper,
        "seed": 1,
        "checkpoints": [steps * repeat for steps in range(30, STEPS + 1, 30)],
        "evaluation_episodes": 1,
        "folder": folder,
        "keep_model": True,
        **changes,
    }


def train(arguments: dict[str, Any], kill: tuple[str, int] | None = None) -> None:
    """
    Train in a process of its own, and leave the replay buffer beside the model.

    :param kill: The process kills itself at this agent step (``step``), or while it writes this checkpoint (``save``)
    """
    th.set_num_threads(1)
    learn, store, sign = SACAux.learn, SACAux._store_transition, training.seal
    saved = 0

    def learn_and_keep(self: SACAux, *args: Any, **kwargs: Any) -> SACAux:
        learn(self, *args, **kwargs)
        self.save_replay_buffer(arguments["folder"] / "replay_buffer.pkl")
        return self

    def store_or_die(self: SACAux, *args: Any) -> None:
        if kill is not None and kill[0] == "step" and self.num_timesteps >= kill[1]:
            os.kill(os.getpid(), signal.SIGKILL)
        store(self, *args)

    def sign_or_die(*args: Any) -> None:
        nonlocal saved
        saved += 1
        if kill == ("save", saved):
            os.kill(os.getpid(), signal.SIGKILL)
        sign(*args)

    SACAux.learn, SACAux._store_transition, training.seal = learn_and_keep, store_or_die, sign_or_die  # type: ignore
    train_candidate(**arguments)


def outcome(folder: Path) -> dict[str, Any]:
    """All that a training leaves, without wall times."""
    model = SACAux.load(folder / "model.zip", device="cpu")
    return {
        "curve": [point[:4] for point in read_curve(folder / "curve.csv")],
        "parameters": model.get_parameters(),
        "random": model._random_state,
        "updates": (model.num_timesteps, model._n_updates, model._episode_num),
        "buffer": pickle.loads((folder / "replay_buffer.pkl").read_bytes()),
    }


def assert_same(one: Any, other: Any, where: str = "") -> int:
    """Equal to the bit, whatever is inside; returns how many arrays were compared."""
    assert type(one) is type(other), where
    if isinstance(one, th.Tensor):
        one, other = one.numpy(), other.numpy()
    if isinstance(one, np.ndarray):
        assert one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes(), where
        return 1
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
        return sum(assert_same(one[key], other[key], f"{where}.{key}") for key in one)
    if isinstance(one, list | tuple):
        assert len(one) == len(other), where
        return sum(assert_same(*pair, f"{where}[{i}]") for i, pair in enumerate(zip(one, other, strict=True)))
    if type(one).__module__.startswith("sb3_aarl"):
        return assert_same(vars(one), vars(other), f"{where}.{type(one).__name__}")
    assert one == other, where
    return 0


@pytest.mark.parametrize("case", CASES)
def test_a_killed_training_ends_as_if_it_had_not_been(
    case: str, tmp_path: Path, processes: multiprocessing.context.ForkServerContext
) -> None:
    rng = np.random.default_rng([ord(letter) for letter in case])
    first, second = sorted(rng.choice(np.arange(1, STEPS), 2, replace=False).tolist())
    undisturbed, killed = (arguments_of(case, tmp_path / name) for name in ("undisturbed", "killed"))

    def run(arguments: dict[str, Any], kill: tuple[str, int] | None) -> int | None:
        process = processes.Process(target=train, args=(arguments, kill))
        process.start()
        process.join()
        return process.exitcode

    assert run(undisturbed, None) == 0
    attempts = [("save", 1), ("step", first), ("step", second), None]
    assert [run(killed, kill) for kill in attempts] == [-signal.SIGKILL] * 3 + [0]
    expected, result = outcome(tmp_path / "undisturbed"), outcome(tmp_path / "killed")
    assert expected["updates"][:2] == (STEPS, STEPS - 20) and len(expected["curve"]) == 5
    assert assert_same(expected, result) > 40
    assert not (tmp_path / "killed" / "checkpoint").exists()


# In this process: interrupted, which leaves what a kill leaves.


def interrupted(arguments: dict[str, Any], at: int = 2) -> Path:
    """The folder of a training that was stopped at one of its evaluations."""

    def stop(evaluation: Evaluation) -> None:
        if evaluation.environment_steps == arguments["checkpoints"][at]:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_candidate(**arguments, on_evaluation=stop)
    return Path(arguments["folder"])


def begins(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Agent steps at which each learning begins."""
    steps: list[int] = []
    learn = SACAux.learn

    def watched(self: SACAux, *args: Any, **kwargs: Any) -> SACAux:
        steps.append(self.num_timesteps)
        return learn(self, *args, **kwargs)

    monkeypatch.setattr(SACAux, "learn", watched)
    return steps


PIXELS = {
    "env_kwargs": {"action_repeat": 40, "pixels": True, "image_size": 16, "frame_stack": 2, "fast_rendering": True},
    "policy_kwargs": {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 8, "n_filters": 4}},
    "augmentation": "none",
}


@pytest.mark.parametrize(
    "hyper",
    [PIXELS, {"env_kwargs": {"action_repeat": 40}, "use_sde": True, "n_envs": 2, "vec_env": "subproc"}],
    ids=["pixels", "noise-and-processes"],
)
def test_other_simulations_go_on_too(
    hyper: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    processes: multiprocessing.context.ForkServerContext,
) -> None:
    changes = {
        "environment": "dm_control/cartpole-swingup-v0",
        "hyperparameters": HYPER | hyper,
        "checkpoints": [800, 1000, 1600],
    }
    undisturbed, killed = (arguments_of("reacher", tmp_path / name, **changes) for name in ("undisturbed", "killed"))
    expected = train_candidate(**undisturbed)
    interrupted(killed, at=1)
    steps = begins(monkeypatch)
    run = train_candidate(**killed)
    assert steps == [20] and "cut off" not in caplog.text
    assert [point[:4] for point in run.curve] == [point[:4] for point in expected.curve]
    one, other = (SACAux.load(tmp_path / name / "model.zip") for name in ("undisturbed", "killed"))
    assert assert_same(one.get_parameters(), other.get_parameters()) > 40


def test_a_simulation_that_pickles_without_its_state_is_cut_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    changes = {"environment": "HalfCheetah-v5", "hyperparameters": HYPER | {"env_kwargs": {"action_repeat": 20}}}
    arguments = arguments_of("reacher", tmp_path, checkpoints=[400, 800, 1200], **changes)
    interrupted(arguments)
    steps = begins(monkeypatch)
    run = train_candidate(**arguments)
    assert steps == [40]
    (line,) = (record.getMessage() for record in caplog.records if record.levelno == logging.WARNING)
    assert "cut off" in line and "HalfCheetahEnv" in line and "EzPickle" in line
    assert [point.environment_steps for point in run.curve] == [400, 800, 1200]


# What is not unpickled.


class Malicious:
    """Leaves a file when it is unpickled."""

    def __init__(self, marker: Path):
        self.marker = marker

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.marker,)


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a training that was stopped."""
    return interrupted(arguments_of("pendulum", tmp_path_factory.mktemp("left") / "run"))


def replace_pickle(name: str) -> Callable[[Path, bytes], None]:
    return lambda folder, code: (folder / name).write_bytes(code) and None


def replace_in_model(folder: Path, code: bytes) -> None:
    with zipfile.ZipFile(folder / "model.zip") as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(parts["data"])
    data["action_noise"] = {":type:": "object", ":serialized:": base64.b64encode(code).decode()}
    parts["data"] = json.dumps(data).encode()
    with zipfile.ZipFile(folder / "model.zip", "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)


@pytest.mark.parametrize("signed", [False, True], ids=["old-signature", "other-key"])
@pytest.mark.parametrize(
    "attack",
    [replace_pickle("replay_buffer.pkl"), replace_pickle("environments.pkl"), replace_in_model],
    ids=["buffer", "simulation", "model"],
)
def test_what_others_wrote_is_not_unpickled(
    attack: Callable[[Path, bytes], None],
    signed: bool,
    left: Path,
    key: bytes,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    folder, marker = tmp_path / "run", tmp_path / "marker"
    shutil.copytree(left, folder)
    (saved,) = (folder / "checkpoint").iterdir()
    attack(saved, pickle.dumps(Malicious(marker)))
    if signed:
        (saved / "manifest").unlink()
        seal(saved, bytes(32), {"cut_off": None})
    arguments = arguments_of("pendulum", folder, checkpoints=[30, 60, 90, 120, 150])

    def no_training(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(SACAux, "learn", no_training)
    with pytest.raises(KeyboardInterrupt):
        train_candidate(**arguments)
    assert not marker.exists()
    (line,) = (record.getMessage() for record in caplog.records if "begins anew" in record.getMessage())
    assert ("signed" in line) is signed and ("not what was written" in line) is not signed
    assert not saved.exists()

    # The attack would do, if it were let.
    shutil.copytree(left, folder, dirs_exist_ok=True)
    attack(saved, pickle.dumps(Malicious(marker)))
    (saved / "manifest").unlink()
    seal(saved, key, {"cut_off": None})
    with pytest.raises(KeyboardInterrupt):
        train_candidate(**arguments)
    assert marker.exists()


@pytest.fixture
def sealed(tmp_path: Path, key: bytes) -> Path:
    folder = tmp_path / "sealed"
    folder.mkdir()
    for name in ("a", "b"):
        (folder / name).write_bytes(name.encode() * 100)
    seal(folder, key, {"n": 1})
    return folder


def exchange(folder: Path) -> None:
    (folder / "a").rename(folder / "c")
    (folder / "b").rename(folder / "a")
    (folder / "c").rename(folder / "b")


def link(folder: Path) -> None:
    (folder / "a").rename(folder.parent / "elsewhere")
    (folder / "a").symlink_to(folder.parent / "elsewhere")


def put(name: str, make: Callable[[Path], Any]) -> Callable[[Path], None]:
    def replace(folder: Path) -> None:
        (folder / name).unlink()
        make(folder / name)

    return replace


def edit_manifest(folder: Path) -> None:
    signature, _, content = (folder / "manifest").read_bytes().partition(b"\n")
    (folder / "manifest").write_bytes(signature + b"\n" + content.replace(b'"n": 1', b'"n": 2'))


@pytest.mark.parametrize(
    ("alter", "reason"),
    [
        (exchange, "a is not what was written"),
        (link, "a is no plain file"),
        (put("a", os.mkfifo), "a is no plain file"),  # which would be waited for
        (put("b", Path.mkdir), "b is no plain file"),
        (put("a", lambda path: None), "a cannot be read: No such file"),
        (put("a", lambda path: path.write_bytes(b"a" * 99)), "a is not what was written"),
        (put("manifest", lambda path: path.write_bytes(b"")), "torn, or not signed"),
        (put("manifest", Path.mkdir), "manifest is no plain file"),
        (edit_manifest, "torn, or not signed"),
        (shutil.rmtree, "manifest cannot be read"),
    ],
    ids=["exchanged", "link", "pipe", "folder", "missing", "short", "no-signature", "manifest-folder", "edited", "gone"],
)
def test_a_folder_that_was_altered_is_refused(sealed: Path, key: bytes, alter: Callable[[Path], None], reason: str) -> None:
    with opened(sealed, key) as (files, about):
        assert {name: file.read() for name, file in files.items()} == {"a": b"a" * 100, "b": b"b" * 100}
        assert about == {"n": 1}
    for wrong in (bytes(32), None):
        with pytest.raises(CheckpointError), opened(sealed, wrong):
            pass
    alter(sealed)
    with pytest.raises(CheckpointError, match=reason), opened(sealed, key):
        pass


def test_another_python_is_refused(sealed: Path, key: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pickled functions have the code of one version."""
    monkeypatch.setattr(checkpoint, "PYTHON", "3.99")
    with pytest.raises(CheckpointError, match=r"has written it, this is 3\.99"), opened(sealed, key):
        pass


# The key.


def test_processes_that_begin_at_once_make_one_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processes: multiprocessing.context.ForkServerContext
) -> None:
    monkeypatch.setenv(checkpoint.KEY_VARIABLE, "")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    path = tmp_path / "state" / "sb3-aarl" / "key"
    assert checkpoint.key_path() == path
    started, keys = processes.Barrier(6), processes.SimpleQueue()
    workers = [processes.Process(target=ask_for_key, args=(path, started, keys)) for _ in range(6)]
    for worker in workers:
        worker.start()
    assert {keys.get() for _ in workers} == {path.read_bytes()}
    for worker in workers:
        worker.join()
    assert len(path.read_bytes()) == 32 and stat.S_IMODE(path.stat().st_mode) == 0o600
    assert [file.name for file in path.parent.iterdir()] == ["key"]


def ask_for_key(path: Path, started: Any, keys: Any) -> None:
    os.environ[checkpoint.KEY_VARIABLE] = str(path)
    started.wait()
    keys.put(user_key())


def open_to_others(path: Path) -> None:
    path.write_bytes(bytes(32))
    path.chmod(0o644)


def too_short(path: Path) -> None:
    path.touch(0o600)


@pytest.mark.parametrize(
    ("make", "reason"),
    [(lambda path: path.parent.rmdir() or path.parent.touch(), ""), (open_to_others, "0600"), (too_short, "32 bytes")],
    ids=["no-home", "open-to-others", "too-short"],
)
def test_without_a_key_trainings_keep_no_checkpoints(
    make: Callable[[Path], Any],
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    path = tmp_path / "home" / "key"
    path.parent.mkdir()
    make(path)
    monkeypatch.setenv(checkpoint.KEY_VARIABLE, str(path))
    arguments = arguments_of("pendulum", tmp_path / "run", checkpoints=[10, 20, 30])
    assert not list((interrupted(arguments) / "checkpoint").glob("*"))
    assert len(train_candidate(**arguments).curve) == 3
    (line,) = (record.getMessage() for record in caplog.records if record.levelno == logging.WARNING)
    assert "No checkpoints are kept" in line and str(path) in line and reason in line


def test_a_checkpoint_waits_for_the_key_that_it_was_signed_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A home that is away for a moment says nothing about a checkpoint."""
    key = tmp_path / "key"
    monkeypatch.setenv(checkpoint.KEY_VARIABLE, str(key))
    arguments = arguments_of("pendulum", tmp_path / "run", checkpoints=[10, 20, 30])
    (saved,) = (interrupted(arguments) / "checkpoint").iterdir()
    key.chmod(0o644)
    checkpoint._key.cache_clear()  # as in another process
    with pytest.raises(PermissionError, match=f"{saved} cannot be read without the key in {key}"):
        train_candidate(**arguments)
    key.chmod(0o600)
    checkpoint._key.cache_clear()
    begun = begins(monkeypatch)
    train_candidate(**arguments)
    assert begun == [20]


# Full disks.


class Disk:
    """A small disk of its own; where none can be mounted, a limit for the size of files."""

    def __init__(self, path: Path, mounted: bool):
        self.path = path
        self.mounted = mounted
        self.errno = errno.ENOSPC if mounted else errno.EFBIG
        self._limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(self) -> None:
        if not self.mounted:
            resource.setrlimit(resource.RLIMIT_FSIZE, (0, self._limits[1]))
            return
        with pytest.raises(OSError, match="No space"), (self.path / "filler").open("wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))

    def free(self) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, self._limits)
        (self.path / "filler").unlink(missing_ok=True)


@pytest.fixture(params=["tmpfs", "limit"])
def disk(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Disk]:
    path = tmp_path / "disk"
    path.mkdir()
    mounted = False
    if request.param == "tmpfs":
        command = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(path)]
        mounted = shutil.which("mount") is not None and subprocess.run(command, capture_output=True).returncode == 0
        if not mounted:
            pytest.skip("no tmpfs can be mounted")
    disk = Disk(path, mounted)
    yield disk
    disk.free()
    if mounted:
        subprocess.run(["umount", str(path)], check=True)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> list[Evaluation]:
    arguments = arguments_of("pendulum", tmp_path_factory.mktemp("undisturbed"), checkpoints=[30, 60, 90])
    return train_candidate(**arguments).curve


@pytest.mark.parametrize("full", ["checkpoint", "curve", "model"])
def test_a_full_disk_loses_nothing(
    disk: Disk,
    full: str,
    undisturbed: list[Evaluation],
    key: bytes,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = disk.path / "run"
    arguments = arguments_of("pendulum", run, checkpoints=[30, 60, 90])
    save = training._RunFolder.save

    def save_and_fill(self: Any, *args: Any) -> None:
        save(self, *args)
        disk.fill()

    def fill(evaluation: Evaluation) -> None:
        if evaluation.environment_steps == {"checkpoint": 60, "model": 90}.get(full):
            disk.fill()

    with monkeypatch.context() as patch:
        if full == "curve":
            patch.setattr(training._RunFolder, "save", save_and_fill)
        with pytest.raises(OSError) as error:
            train_candidate(**arguments, on_evaluation=fill)
        disk.free()
    assert type(error.value) is OSError and error.value.errno == disk.errno
    last = {"checkpoint": 30, "curve": 30, "model": 60}[full]
    assert [path.name for path in (run / "checkpoint").iterdir()] == [str(last)]
    with opened(run / "checkpoint" / str(last), key):
        pass
    assert not list(run.glob("*.zip"))

    steps = begins(monkeypatch)
    curve = train_candidate(**arguments).curve
    assert steps == [last]
    assert [point[:4] for point in curve] == [point[:4] for point in undisturbed]
    assert SACAux.load(run / "model.zip").num_timesteps == 90


def test_two_trainings_in_one_folder_do_no_harm_to_each_other(tmp_path: Path) -> None:
    """A worker that was taken for dead goes on, while another one has got its candidate."""
    environment, settings = CASES["pendulum"]
    arguments = (environment, LOSS, HYPER | settings, 0, [30, 60, 90], 1)
    undisturbed = train_candidate(*arguments, tmp_path / "undisturbed")
    folder = tmp_path / "shared"

    def other(evaluation: Evaluation) -> None:
        if evaluation.environment_steps == 60:
            # It finds the checkpoint of the first evaluation, overtakes, and ends.
            assert train_candidate(*arguments, folder).aulc == undisturbed.aulc

    # Its own figures differ here only because both draw from the generators of one process.
    run = train_candidate(*arguments, folder, on_evaluation=other)
    assert run.curve[:2] == read_curve(folder / "curve.csv")[:2] and len(run.curve) == 3
    assert not (folder / "checkpoint").exists()


def test_a_worker_that_was_taken_for_dead_leaves_later_checkpoints_alone(tmp_path: Path) -> None:
    environment, settings = CASES["pendulum"]
    arguments = (environment, LOSS, HYPER | settings, 0, [30, 60, 90], 1)
    folder = tmp_path / "shared"

    def stop(evaluation: Evaluation) -> None:
        if evaluation.environment_steps == 90:
            raise KeyboardInterrupt

    def other(evaluation: Evaluation) -> None:
        if evaluation.environment_steps == 60:
            with pytest.raises(KeyboardInterrupt):
                train_candidate(*arguments, folder, stop)
            (folder / "checkpoint" / "60").rename(folder / "checkpoint" / "75")  # it is further

    with pytest.raises(KeyboardInterrupt):
        train_candidate(*arguments, folder, lambda point: (other(point), stop(point))[0])
    assert sorted(path.name for path in (folder / "checkpoint").iterdir()) == ["60", "75"]


def test_a_checkpoint_that_another_worker_takes_away_is_done_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    environment, settings = CASES["pendulum"]
    arguments = (environment, LOSS, HYPER | settings, 0, [30, 60, 90], 1)
    undisturbed = train_candidate(*arguments).curve
    seal, sealed = training.seal, []

    def seal_once(folder: Path, *of: Any) -> None:
        sealed.append(folder)
        if len(sealed) == 2:
            shutil.rmtree(folder.parent)
        seal(folder, *of)

    monkeypatch.setattr(training, "seal", seal_once)
    curve = train_candidate(*arguments, tmp_path).curve
    assert [point[:4] for point in curve] == [point[:4] for point in undisturbed]
    assert "another worker took it away" in caplog.text and len(sealed) == 2


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("[enforce fail at alloc_cpu.cpp:117] DefaultCPUAllocator: can't allocate memory"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        RuntimeError("CUDA error: CUDA-capable device(s) is/are busy or unavailable"),
    ],
    ids=["memory", "tensor", "system", "gpu"],
)
def test_a_checkpoint_waits_for_a_process_that_has_room_for_it(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment, settings = CASES["pendulum"]
    arguments = (environment, LOSS, HYPER | settings, 0, [30, 60, 90], 1)
    undisturbed = train_candidate(*arguments).curve

    def stop(evaluation: Evaluation) -> None:
        if evaluation.environment_steps == 60:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_candidate(*arguments, tmp_path, stop)

    def load(*of: Any, **keywords: Any) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(SACAux, "load_replay_buffer", load)
        message = r"^the checkpoint .*/30 could not be taken up, remove it to begin anew: (out of memory|the GPU failed)"
        with pytest.raises(training.DeviceError, match=message):
            train_candidate(*arguments, tmp_path)
    assert [path.name for path in (tmp_path / "checkpoint").iterdir()] == ["30"]
    steps = begins(monkeypatch)
    curve = train_candidate(*arguments, tmp_path).curve
    assert steps == [30]
    assert [point[:4] for point in curve] == [point[:4] for point in undisturbed]


def test_a_gpu_that_fails_costs_neither_checkpoint_nor_candidate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    environment, settings = CASES["pendulum"]
    arguments = (environment, LOSS, HYPER | settings, 0, [30, 60, 90], 1, tmp_path)
    step = SACAux._gradient_step

    def fail(model: SACAux, *of: Any) -> Any:
        if model.num_timesteps > 40:
            raise RuntimeError("CUDA error: an illegal memory access was encountered\nCUDA kernel errors might be reported")
        return step(model, *of)

    with monkeypatch.context() as patch:
        patch.setattr(SACAux, "_gradient_step", fail)
        with pytest.raises(training.DeviceError, match=r"^the GPU failed: CUDA error: an illegal memory access was"):
            train_candidate(*arguments)
    assert [path.name for path in (tmp_path / "checkpoint").iterdir()] == ["30"]
    assert [point.environment_steps for point in train_candidate(*arguments).curve] == [30, 60, 90]


@pytest.mark.parametrize("code", [errno.ESTALE, errno.ENOTCONN, errno.EACCES], ids=errno.errorcode.get)
def test_a_folder_that_goes_away_is_not_the_candidates_fault(
    code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment, settings = CASES["pendulum"]
    arguments = (environment, LOSS, HYPER | settings, 0, [30, 60, 90], 1, tmp_path)
    save, saved = training._RunFolder.save, []

    def fails_once(*of: Any) -> None:
        saved.append(of)
        if len(saved) == 2:
            raise OSError(code, os.strerror(code))
        save(*of)

    monkeypatch.setattr(training._RunFolder, "save", fails_once)
    with pytest.raises(OSError) as raised:
        train_candidate(*arguments)
    assert raised.value.errno == code
    assert [path.name for path in (tmp_path / "checkpoint").iterdir()] == ["30"]
    assert [point.environment_steps for point in train_candidate(*arguments).curve] == [30, 60, 90]
