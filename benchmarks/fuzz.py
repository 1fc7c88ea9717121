"""
Hostile input, made at random out of what is real: only documented errors may come of it, and nothing may be executed.

    python benchmarks/fuzz.py checkpoint --inputs 100000  # or notation, config
"""

import base64
import hashlib
import io
import json
import logging
import os
import pickle
import random
import shutil
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import hypothesis
import torch as th
import typer
from fuzz_texts import configurations, notations
from hypothesis import HealthCheck, strategies
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress
from rich.table import Table
from stable_baselines3.common.env_util import make_vec_env

from search.training import checkpoint
from search.training import run as training
from search.training.provenance import save_result

# Tries an input that it makes with a random generator, and says what it was and what came of it. What it raises is a bug.
Attempt = Callable[[random.Random], tuple[str, str]]


class Malicious:
    """
    Leaves a file when it is unpickled.

    :param marker: The file
    """

    def __init__(self, marker: Path):
        self.marker = marker

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.marker,)


def malicious_model(model: bytes, marker: Path) -> bytes:
    """A model that would execute code when SB3 reads its attributes, and when torch reads its parameters unsafely."""
    with zipfile.ZipFile(io.BytesIO(model)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(parts["data"])
    data["action_noise"] = {":type:": "object", ":serialized:": base64.b64encode(pickle.dumps(Malicious(marker))).decode()}
    parameters = io.BytesIO()
    th.save(Malicious(marker), parameters)
    parts |= {"data": json.dumps(data).encode(), "policy.pth": parameters.getvalue()}
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, part in parts.items():
            archive.writestr(name, part)
    return content.getvalue()


def checkpoints(folder: Path, marker: Path) -> Attempt:
    """
    Checkpoints of a real training, altered in one to three ways, loaded as by a training that goes on.

    The training begins anew, or goes on with the very files that were written.

    :param folder: An empty folder
    :param marker: What executed code leaves
    """
    os.environ[checkpoint.KEY_VARIABLE] = str(folder / "key")
    hyperparameters = {
        "env_kwargs": {},
        "buffer_size": 16,
        "learning_starts": 4,
        "batch_size": 4,
        "predictor_width": 4,
        "policy_kwargs": {"net_arch": [4], "features_extractor_kwargs": {"features_dim": 4, "width": 4}},
        "device": "cpu",
    }

    def train(seed: int) -> dict[str, bytes]:
        """The files of a checkpoint."""

        def stop(evaluation: training.Evaluation) -> None:
            if evaluation.environment_steps == 16:
                raise KeyboardInterrupt

        run = folder / f"run-{seed}"
        try:
            training.train_candidate("Pendulum-v1", "{s_t, a_t} -> {s_t+1}", hyperparameters, seed, [8, 16], 1, run, stop)
        except KeyboardInterrupt:
            return {path.name: path.read_bytes() for path in (run / "checkpoint" / "8").iterdir()}
        raise AssertionError("the training was not stopped")

    files, foreign = train(0), train(1)
    names = sorted(files)
    code = pickle.dumps(Malicious(marker))
    poisoned_model = malicious_model(files["model.zip"], marker)
    poisoned = {"model.zip": poisoned_model, "replay_buffer.pkl": code, "environments.pkl": code}
    outside = folder / "outside"
    outside.mkdir()
    for name, content in files.items():
        (outside / name).write_bytes(content)

    store = training._RunFolder(folder / "victim", "", 0, None)
    store.description = json.loads(files["run.json"])
    saved = folder / "victim" / "checkpoint" / "8"
    env = make_vec_env(
        training.make_env,
        env_kwargs={"env_id": "Pendulum-v1", "env_kwargs": {}},
        wrapper_class=checkpoint.ResumableEnv,
    )
    reasons: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: reasons.append(record.getMessage())  # type: ignore[method-assign]
    training.logger.addHandler(handler)
    training.logger.propagate = False

    def put(path: Path, content: bytes) -> None:
        training._remove(path)
        path.write_bytes(content)

    def truncate(rng: random.Random, path: Path) -> None:
        content = path.read_bytes()
        path.write_bytes(content[: rng.randrange(len(content) or 1)])

    def flip(rng: random.Random, path: Path) -> None:
        content = bytearray(path.read_bytes() or b"\0")
        for _ in range(rng.randint(1, 8)):
            content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        path.write_bytes(content)

    def overwrite(rng: random.Random, path: Path) -> None:
        path.write_bytes(rng.randbytes(rng.choice((0, 1, 100, 2000))))

    def append(rng: random.Random, path: Path) -> None:
        with path.open("ab") as file:
            file.write(rng.randbytes(rng.randint(1, 100)))

    def splice(rng: random.Random, path: Path) -> None:
        if rng.random() < 0.2:  # all of it: the user's own, but of another training
            for name, content in foreign.items():
                put(path.with_name(name), content)
        else:
            path.write_bytes(foreign[rng.choice(names)])

    def exchange(rng: random.Random, path: Path) -> None:
        other = path.with_name(rng.choice(names))
        if other != path and other.exists():
            path.rename(path.with_name("between"))
            other.rename(path)
            path.with_name("between").rename(other)

    def poison(rng: random.Random, path: Path) -> None:
        path.write_bytes(poisoned.get(path.name, code))

    def replace(rng: random.Random, path: Path) -> None:
        path.unlink()
        rng.choice(
            (
                lambda: None,
                path.mkdir,
                lambda: os.mkfifo(path),
                lambda: path.symlink_to(outside / path.name),
                lambda: path.symlink_to(rng.choice((path, "/dev/zero", "nowhere", outside))),
                lambda: os.link(outside / path.name, path),  # of equal content: no harm
            )
        )()

    def sign(rng: random.Random, path: Path) -> None:
        """Poisoned throughout, and signed with what is not the user's key."""
        for name, content in poisoned.items():
            put(path.with_name(name), content)
        for name in ("curve.csv", "run.json", "manifest"):
            put(path.with_name(name), files[name])
        path.with_name("manifest").unlink()
        checkpoint.seal(path.parent, rng.randbytes(32), {"cut_off": None})

    def edit_manifest(rng: random.Random, path: Path) -> None:
        signature, _, content = files["manifest"].partition(b"\n")
        edited = json.loads(content)
        if rng.random() < 0.5:
            put(path.with_name("replay_buffer.pkl"), code)
            edited["files"]["replay_buffer.pkl"] = [len(code), hashlib.sha256(code).hexdigest()]
        else:
            edited["files"][rng.choice(("../../../key", "/etc/passwd", "x" * 300, "a\0b"))] = [32, "0" * 64]
        body = json.dumps(edited).encode() if rng.random() < 0.9 else b"[" * 200_000
        put(path.with_name("manifest"), rng.choice((signature, b"", b"0" * 64)) + b"\n" + body)

    def rename(rng: random.Random, path: Path) -> None:
        """Other names beside the checkpoint: the largest number is taken for the newest."""
        name = rng.choice(("unfinished", "9" * 200, "9" * 200, "٩", "٩"))
        if rng.random() < 0.5:
            path.parent.with_name(name).mkdir()
            path.parent.with_name(name).joinpath(path.name).write_bytes(files[path.name])
        else:
            path.parent.with_name(name).symlink_to(outside)

    alterations = (truncate, flip, overwrite, append, splice, exchange, poison, replace, sign, edit_manifest, rename)

    def attempt(rng: random.Random) -> tuple[str, str]:
        shutil.rmtree(folder / "victim", ignore_errors=True)
        saved.mkdir(parents=True)
        for name, content in files.items():
            (saved / name).write_bytes(content)
        done = []
        for alter in rng.sample(alterations, rng.choice((1, 1, 2, 3))):
            path = saved / rng.choice(names)
            # Not what a link of another alteration leads to.
            if path.is_file() and not path.is_symlink() and path.stat().st_nlink == 1:
                alter(rng, path)
                done.append(alter.__name__)
        model, curve = store.load(env, "cpu")
        assert {path.name: path.read_bytes() for path in outside.iterdir()} == files, "something else was altered"
        if model is None:
            assert not curve and not (folder / "victim" / "checkpoint").exists()
            reason = reasons.pop().partition("anew: ")[2] if reasons else "no checkpoint"
            for part in names:
                reason = reason.replace(part, "FILE")
            return "+".join(done[:1]), reason.partition(" (")[0]
        assert model.num_timesteps == 8 and curve[-1].environment_steps == 8 and not reasons
        return "+".join(done[:1]), "unaltered, loaded"

    return attempt


TARGETS: dict[str, Callable[[Path, Path], Attempt]] = {
    "checkpoint": checkpoints,
    "notation": notations,
    "config": configurations,
}


def main(
    target: Annotated[str, typer.Argument(help=f"one of: {', '.join(TARGETS)}")],
    inputs: Annotated[int, typer.Option(help="how many")] = 100_000,
    seed: Annotated[int, typer.Option(help="other inputs with another one")] = 0,
    out: Annotated[Path | None, typer.Option(help="JSON file for the counts")] = None,
) -> None:
    """Feed a target with hostile inputs; the first undocumented exception, or execution, ends it."""
    if target not in TARGETS:
        raise typer.BadParameter(f"unknown target {target!r}, there are: {', '.join(TARGETS)}")
    th.set_num_threads(1)
    console = Console()
    outcomes: Counter[tuple[str, str]] = Counter()
    slowest = 0.0
    with (
        tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as name,
        Progress(*Progress.get_default_columns(), MofNCompleteColumn(), console=console) as bar,
    ):
        folder, marker = Path(name) / "target", Path(name) / "executed"
        folder.mkdir()
        attempt = TARGETS[target](folder, marker)
        task = bar.add_task(target, total=inputs)

        # Inputs are too large to be drawn choice by choice: hypothesis draws the seeds, and names that of a failure.
        @hypothesis.seed(seed)
        @hypothesis.settings(max_examples=inputs, database=None, deadline=None, suppress_health_check=list(HealthCheck))
        @hypothesis.given(strategies.randoms(use_true_random=True))
        def fuzz(rng: random.Random) -> None:
            nonlocal slowest
            before = time.monotonic()
            outcomes[attempt(rng)] += 1
            slowest = max(slowest, time.monotonic() - before)
            assert not marker.exists(), "it was executed"
            bar.advance(task)

        started = time.monotonic()
        fuzz()
        seconds = time.monotonic() - started
    table = Table("input", "outcome", "count", title=f"{inputs:,} inputs, {seconds:.0f} s, the slowest {slowest:.3f} s")
    for (kind, outcome), count in sorted(outcomes.items()):
        table.add_row(kind, outcome, f"{count:,}")
    console.print(table)
    if out is not None:
        counts: dict[str, dict[str, int]] = {}
        for (kind, outcome), count in sorted(outcomes.items()):
            counts.setdefault(kind, {})[outcome] = count
        measured = {"inputs": outcomes.total(), "seconds": round(seconds, 1), "slowest_seconds": round(slowest, 3)}
        save_result(out, target=target, seed=seed, **measured, outcomes=counts, executed=0)


if __name__ == "__main__":
    typer.run(main)
