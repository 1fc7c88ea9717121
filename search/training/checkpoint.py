"""Checkpoints: signed with a key of the user's, read back only if they are still what was written; simulations in them."""

import contextlib
import errno
import functools
import hashlib
import hmac
import io
import json
import logging
import os
import pickle
import secrets
import stat
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cloudpickle  # type: ignore[import-untyped]
import gymnasium as gym
from gymnasium.utils import EzPickle
from shimmy.dm_control_compatibility import DmControlCompatibilityV0

logger = logging.getLogger(__name__)

# Names a file for the user's key, such as one that all machines of a cluster share.
KEY_VARIABLE = "AARL_KEY_FILE"
KEY_BYTES = 32
MANIFEST = "manifest"
# Of the signature's purpose, and of the manifest's form.
PURPOSE = b"sb3-aarl checkpoint 1\n"
# A manifest has a kilobyte.
LARGEST_MANIFEST = 2**20
# Code of functions is in the pickles of environments.
PYTHON = ".".join(map(str, sys.version_info[:2]))
DISK_ERRORS = {errno.ENOSPC, errno.EFBIG, errno.EIO, errno.EROFS, getattr(errno, "EDQUOT", errno.ENOSPC)}


class CheckpointError(ValueError):
    """A checkpoint is not what this user's runs have written; the message says why in one line."""


def is_disk_error(error: BaseException) -> bool:
    """Whether a disk, not what was written to it, is at fault: it is full, over quota, broken or read-only."""
    return isinstance(error, OSError) and error.errno in DISK_ERRORS


def key_path() -> Path:
    """
    The file of the user's key: what the environment variable ``AARL_KEY_FILE`` names, else ``sb3-aarl/key`` in
    ``$XDG_STATE_HOME`` or ``~/.local/state``.

    Machines that share checkpoints have to share the key.
    """
    if os.environ.get(KEY_VARIABLE):
        return Path(os.environ[KEY_VARIABLE])
    state = os.environ.get("XDG_STATE_HOME", "")
    return Path(state if os.path.isabs(state) else "~/.local/state") / "sb3-aarl" / "key"


def user_key() -> bytes | None:
    """
    The user's secret key, made when it is first asked for.

    :return: 32 random bytes. None, with one warning in each process, where the file can be neither read nor made, or others
        could read it: no checkpoints are kept then, trainings that are killed begin anew, and those that have one already are
        refused
    """
    return _key(key_path())


@functools.cache
def _key(path: Path) -> bytes | None:
    try:
        file = path.expanduser()
        if not file.exists():
            _make_key(file)
        return _read_key(file)
    except (OSError, RuntimeError, CheckpointError) as error:  # RuntimeError: a user without a home
        logger.warning(
            "No checkpoints are kept, trainings that are killed will begin anew: no key in %s (%s). %s may name another file",
            path,
            error,
            KEY_VARIABLE,
        )
        return None


def _make_key(path: Path) -> None:
    """In one step: of several processes one makes it, and none sees a part of it."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    descriptor, unfinished = tempfile.mkstemp(dir=path.parent)  # which nobody else may read
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(secrets.token_bytes(KEY_BYTES))
            file.flush()
            os.fsync(file.fileno())
        with contextlib.suppress(FileExistsError):
            os.link(unfinished, path)
    finally:
        os.unlink(unfinished)


def _read_key(path: Path) -> bytes:
    with path.open("rb") as file:
        status = os.fstat(file.fileno())
        if os.name == "posix" and (status.st_uid != os.geteuid() or status.st_mode & 0o077):
            raise CheckpointError("others may read or write it: it has to be yours, with mode 0600")
        key = file.read(KEY_BYTES + 1)
    if len(key) != KEY_BYTES:
        raise CheckpointError(f"it has not the {KEY_BYTES} bytes of a key")
    return key


def seal(folder: Path, key: bytes, about: Mapping[str, Any]) -> None:
    """
    Sign the files of a folder, and see to it that they are on the disk.

    :param folder: Has plain files only
    :param key: The user's key
    :param about: Told to who opens it; plain values
    """
    digests = {}
    for path in sorted(folder.iterdir()):
        with path.open("rb+") as file:
            os.fsync(file.fileno())
            digests[path.name] = [path.stat().st_size, _digest(file)]
    content = json.dumps({"about": dict(about), "files": digests, "python": PYTHON}).encode()
    with (folder / MANIFEST).open("wb") as file:
        file.write(_signature(key, content) + b"\n" + content)
        file.flush()
        os.fsync(file.fileno())
    sync_folder(folder)


@contextlib.contextmanager
def opened(folder: Path, key: bytes | None) -> Iterator[tuple[dict[str, io.BufferedReader], dict[str, Any]]]:
    """
    The files of a sealed folder. None is given out before all are found to be as they were.

    What is done to the folder later, short of writing into the very files that are open, does not change what is read.

    :param folder: The folder
    :param key: The user's key, None if there is none
    :return: The open files by name, and what ``seal`` was told
    :raises CheckpointError: when it is torn, altered, another user's or another Python's
    :raises OSError: when the disk cannot be read
    """
    if key is None:
        raise CheckpointError("there is no key to check it with")
    with contextlib.ExitStack() as stack:
        manifest = _read_manifest(stack.enter_context(_open(folder / MANIFEST)), key)
        if manifest["python"] != PYTHON:
            raise CheckpointError(f"Python {manifest['python']} has written it, this is {PYTHON}")
        files = {name: stack.enter_context(_open(folder / name)) for name in manifest["files"]}
        for name, (size, digest) in manifest["files"].items():
            if os.fstat(files[name].fileno()).st_size != size or _digest(files[name]) != digest:
                raise CheckpointError(f"{name} is not what was written")
            files[name].seek(0)
        yield files, manifest["about"]


def _read_manifest(file: io.BufferedReader, key: bytes) -> dict[str, Any]:
    """Nothing of it is read before its signature is."""
    signature, _, content = file.read(LARGEST_MANIFEST).partition(b"\n")
    if not hmac.compare_digest(signature, _signature(key, content)):
        raise CheckpointError(f"its {MANIFEST} is torn, or not signed with this user's key ({key_path()})")
    return json.loads(content)


def _signature(key: bytes, content: bytes) -> bytes:
    return hmac.digest(key, PURPOSE + content, "sha256").hex().encode()


def _digest(file: io.BufferedIOBase) -> str:
    digest = hashlib.sha256()
    while block := file.read(2**20):
        digest.update(block)
    return digest.hexdigest()


def _open(path: Path) -> io.BufferedReader:
    """A plain file: no link, no folder, and no pipe, which would be waited for."""
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    try:
        descriptor = os.open(path, flags)
    except OSError as error:
        # What else there is, such as a server that does not answer, says nothing of the checkpoint.
        if isinstance(error, FileNotFoundError | NotADirectoryError | IsADirectoryError | PermissionError):
            raise CheckpointError(f"{path.name} cannot be read: {error.strerror}") from None
        if error.errno in (errno.ELOOP, errno.ENXIO):
            raise CheckpointError(f"{path.name} is no plain file") from None
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise CheckpointError(f"{path.name} is no plain file")
    return os.fdopen(descriptor, "rb")


def sync_folder(folder: Path) -> None:
    """See to it that names in a folder are on the disk."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


class _NotSavedError(Exception):
    """The state of a simulation cannot be saved."""


class _Pickler(cloudpickle.Pickler):
    """Refuses what would be pickled without its state."""

    def persistent_id(self, obj: Any) -> None:
        loses_state = isinstance(obj, EzPickle) and type(obj).__getstate__ is EzPickle.__getstate__
        # The argument of shimmy's constructor is the simulation, which is pickled whole.
        if loses_state and type(obj) is not DmControlCompatibilityV0:
            raise _NotSavedError(f"{type(obj).__name__} pickles the arguments of its constructor only (EzPickle)")


class ResumableEnv(gym.Wrapper):
    """
    An environment whose state can be saved in the middle of an episode, and put back into another one of its kind.

    :param env: The environment, ``Monitor`` included. What it pickles has to be all of its state
    """

    def dump_state(self) -> bytes | str:
        """All of its state; or why it cannot be saved, in one line."""
        buffer = io.BytesIO()
        try:
            _Pickler(buffer).dump(self.env)
        except Exception as error:  # whatever an environment's own pickling raises
            reason = str(error) if isinstance(error, _NotSavedError) else f"{type(error).__name__}: {error}"
            return " ".join(reason.split())
        return buffer.getvalue()

    def load_state(self, state: bytes) -> str | None:
        """
        Go on from a state.

        :param state: What ``dump_state`` gave. It is unpickled: it has to be the user's own
        :return: Why it cannot be, in one line; None if it can
        """
        try:
            env = pickle.loads(state)
        except Exception as error:  # such as the simulator's, which is of another version
            return " ".join(f"{type(error).__name__}: {error}".split())
        self.env.close()
        self.env = env
        return None
