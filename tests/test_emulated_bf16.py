"""results/emulated_bf16.py gives what bfloat16 is, and trains runs of a benchmark with it."""

import re
import runpy
import shutil
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import optuna
import pytest
import torch as th
from test_sac_aux import filled_model
from torch.utils._python_dispatch import TorchDispatchMode, _get_current_dispatch_mode

import search.studies.benchmark
from sb3_aarl.callbacks import Evaluation
from search.training.provenance import read_about

ROOT = Path(__file__).parent.parent
emulated: dict[str, Any] = runpy.run_path(str(ROOT / "results" / "emulated_bf16.py"))
EmulatedBfloat16: type[TorchDispatchMode] = emulated["EmulatedBfloat16"]


class Natively(TorchDispatchMode):
    """What PyTorch is asked to do with bfloat16."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: set[Any] = set()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if any(isinstance(arg, th.Tensor) and arg.dtype == th.bfloat16 for arg in args):
            self.asked.add(function)
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize("n_batches", [0, 3])
def test_products_are_rounded_once(n_batches: int) -> None:
    shape = [n_batches] * (n_batches > 0)
    a, b, c = (th.randn(*shape, *size).bfloat16() for size in ((40, 64), (30, 64), (40, 30)))
    exact = a.double() @ b.double().mT
    with EmulatedBfloat16():
        found = {"product": a @ b.mT, "sum": (th.baddbmm if n_batches else th.addmm)(c, a, b.mT)}
        assert (a.float() @ b.float().mT).dtype == th.float32
    for name, expected in (("product", exact), ("sum", c.double() + exact)):
        assert found[name].dtype == th.bfloat16
        # float32's sums may end on the other side of the middle between two of bfloat16's numbers; few do.
        assert (found[name] == expected.bfloat16()).float().mean() > 0.99
        th.testing.assert_close(found[name].double(), expected, rtol=2**-8, atol=1e-5)


def test_gradients_are_those_of_bfloat16() -> None:
    gradients = []
    for precision, mode in (("fp32", nullcontext()), ("bf16", nullcontext()), ("bf16", EmulatedBfloat16())):
        rates: dict[str, float] = {"learning_rate": 0.0, "encoder_learning_rate": 0.0, "ent_coef_learning_rate": 0.0}
        model = filled_model(precision=precision, policy_delay=1, aux_loss="{s_t, a_t} -> {s_t+1, r_t} [bilinear]", **rates)
        with Natively() as natively, mode:
            model.train(1, batch_size=128)
        products = {function for function in natively.asked if re.search("mm|mv|dot|linear|matmul|conv|einsum", str(function))}
        is_native = precision == "bf16" and isinstance(mode, nullcontext)
        assert bool(natively.asked) is (precision == "bf16") and bool(products) is is_native
        assert products <= emulated["PRODUCTS"]  # there is no other
        trained = [*model.critic.parameters(), *model.aux_head.parameters(), *model.actor.own_parameters()]
        gradients.append(th.cat([parameter.grad.flatten() for parameter in trained]))
    exact, native, found = gradients
    assert not th.equal(exact, native)
    assert (found - native).norm() < 0.1 * (exact - native).norm()


def test_runs_are_trained_with_it_and_say_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    choices = ROOT / "zoo_configs" / "choices"
    with pytest.raises(ValueError, match=r"sac_identity_small\.yml does not say precision: bf16"):
        emulated["load_benchmark"]([choices / "sac_identity_small.yml"], ["cheetah-run"], [0], [1000])
    pixels = tmp_path / "pixels.yml"
    pixels.write_text(
        (ROOT / "zoo_configs" / "aarl_pixel.yml").read_text().replace("CnnPolicy", "CnnPolicy\n  precision: bf16")
    )
    with pytest.raises(ValueError, match=r"pixels\.yml does not say policy: MlpPolicy"):
        emulated["load_benchmark"]([pixels], ["cheetah-run"], [0], [1000])
    grid = emulated["load_benchmark"]([choices / "sac_identity_small_bf16.yml"], ["cheetah-run"], [5], [1000])
    plain = search.studies.benchmark.load_benchmark([choices / "sac_identity_small_bf16.yml"], ["cheetah-run"], [5], [1000])
    (cell,) = grid.cells
    assert grid.about(cell) == {**plain.about(cell), "program": "python results/emulated_bf16.py"}

    modes = []

    def train(*_: Any) -> SimpleNamespace:
        modes.append(_get_current_dispatch_mode())
        return SimpleNamespace(curve=[Evaluation(1000, 1.0, 0.0, 10, 2.0)], aux_loss=None, aulc=1.0)

    monkeypatch.setattr(search.studies.benchmark, "train_candidate", train)
    study = optuna.create_study()
    assert grid.train(study.ask(), cell, tmp_path) == 1.0
    assert [type(mode) for mode in modes] == [EmulatedBfloat16] and _get_current_dispatch_mode() is None
    (about,) = (read_about(path.parent) for path in tmp_path.rglob("provenance.json"))
    assert about["program"] == emulated["PROGRAM"] and about["seconds"] == 2.0

    # Neither program goes on with what the other has begun, nor is it shown as one variant.
    emulated["load_benchmark"]([choices / "sac_identity_small_bf16.yml"], ["cheetah-run"], [5], [1000]).prepare(tmp_path)
    with pytest.raises(ValueError, match=r"begun with program='python results/emulated_bf16\.py'"):
        plain.prepare(tmp_path)
    other = tmp_path / "other"
    plain = search.studies.benchmark.load_benchmark([choices / "sac_identity_small_bf16.yml"], ["cheetah-run"], [6], [1000])
    plain.prepare(other)
    (run,) = (path.parent for path in other.rglob("provenance.json"))
    shutil.copytree(run, tmp_path / run.relative_to(other))
    with pytest.raises(ValueError, match="cannot be compared: program="):
        search.studies.benchmark.read_abouts(tmp_path)
