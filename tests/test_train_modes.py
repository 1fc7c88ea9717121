"""The gradient step in bfloat16, and with fused optimizers: still the same step."""

from typing import Any

import numpy as np
import pytest
import torch as th
from test_sac_aux import KINDS, assert_same, everything, filled_model, make_model
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_aarl import sac_aux

PRODUCTS = {"aten.mm", "aten.addmm", "aten.convolution", "aten.convolution_backward"}


class Operations(TorchDispatchMode):
    """The data types of each operation's inputs, by name."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: dict[str, set[th.dtype]] = {}

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        inputs = {arg.dtype for arg in args if isinstance(arg, th.Tensor) and arg.is_floating_point()}
        self.seen.setdefault(str(function).rpartition(".")[0], set()).update(inputs)
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize(("capability", "slow"), [("DEFAULT", True), ("AVX2", True), ("AVX512", False)])
def test_without_instructions_for_bfloat16_trains_in_fp32_with_a_warning(
    capability: str, slow: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(th.backends.cpu, "get_cpu_capability", lambda: capability)
    exact = make_model(precision="fp32", seed=0).learn(40)
    assert not caplog.records
    model = make_model(precision="bf16", seed=0).learn(40)
    expected = ["precision='bf16': this CPU has no instructions for it, training in fp32"] * slow
    assert [record.getMessage() for record in caplog.records] == expected
    same = all(th.equal(one, other) for one, other in zip(exact.critic.parameters(), model.critic.parameters(), strict=True))
    assert same == slow


@pytest.fixture
def computes_bf16(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bfloat16 on any processor, if slowly."""
    monkeypatch.setattr(sac_aux, "computes_bf16", lambda device: True)


@pytest.mark.usefixtures("computes_bf16")
@pytest.mark.parametrize("kind", KINDS)
def test_bfloat16_is_what_networks_compute_in_and_nothing_else(kind: str) -> None:
    model = filled_model(kind, precision="bf16", policy_delay=1, aux_loss="{s_t, a_t} -> {s_t+1, r_t} [bilinear, negatives]")
    outputs: dict[str, th.dtype] = {}
    model.critic.q_networks[0].register_forward_hook(lambda *call: outputs.update(q=call[-1].dtype))
    model.aux_head.predictor.register_forward_hook(lambda *call: outputs.update(predictor=call[-1].dtype))
    losses: list[th.Tensor] = []
    model.aux_head.operator.register_forward_hook(lambda module, args, loss: losses.extend([*args, loss]))
    with Operations() as operations:
        model.train(2, batch_size=16)

    assert outputs == {"q": th.bfloat16, "predictor": th.bfloat16}
    products = {name: operations.seen[name] for name in PRODUCTS & operations.seen.keys()}
    # The similarity of predictions and targets is part of the loss, and stays float32.
    assert products.pop("aten.mm") == {th.bfloat16, th.float32}
    assert products and all(dtypes == {th.bfloat16} for dtypes in products.values())
    assert {tensor.dtype for tensor in losses} == {th.float32}
    for name in ("aten.mse_loss", "aten.log", "aten.exp", "aten._fused_adam_"):
        assert operations.seen[name] <= {th.float32}, name
    for tensor in (value for value in everything(model).values() if isinstance(value, th.Tensor)):
        assert tensor.dtype == th.float32
    for parameter in (*model.critic.parameters(), *model.aux_head.parameters(), *model.actor.own_parameters()):
        assert parameter.grad is not None and parameter.grad.dtype == th.float32


@pytest.mark.usefixtures("computes_bf16")
@pytest.mark.parametrize("kind", KINDS)
def test_bfloat16_computes_almost_the_same_gradients(kind: str) -> None:
    gradients = []
    for precision in ("fp32", "bf16"):
        model = filled_model(kind, precision=precision, policy_delay=1, learning_rate=0.0, aux_kwargs={"learning_rate": 0.0})
        model.train(1, batch_size=128)
        trained = {
            "encoder": model.critic.features_extractor.parameters(),
            "q": model.critic.q_parameters,
            "actor": model.actor.own_parameters(),
            "head": model.aux_head.parameters(),
        }
        gradients.append({name: th.cat([p.grad.flatten() for p in those]) for name, those in trained.items()})
    for name, exact in gradients[0].items():
        assert th.cosine_similarity(exact, gradients[1][name], dim=0) > 0.995, name
        assert not th.equal(exact, gradients[1][name])
        # The encoder's gradients are longer or shorter by 5 % in one of five networks.
        assert exact.norm().item() == pytest.approx(gradients[1][name].norm().item(), rel=0.1), name


@pytest.mark.usefixtures("computes_bf16")
def test_bfloat16_predicts_and_is_saved_in_float32(tmp_path: Any) -> None:
    model = make_model(precision="bf16").learn(40)
    model.save(tmp_path / "model")
    exact = type(model).load(tmp_path / "model", precision="fp32", device="cpu")
    assert exact.precision == "fp32"
    observations = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    assert_same(model.predict(observations, deterministic=True)[0], exact.predict(observations, deterministic=True)[0])


@pytest.mark.usefixtures("computes_bf16")
@pytest.mark.slow
@pytest.mark.parametrize(
    ("backend", "precision", "norm", "tolerance"), [("inductor", "fp32", "batch", 1e-4), ("aot_eager", "bf16", None, 0.05)]
)
def test_compiled_losses_have_the_same_gradients(
    backend: str, precision: str, norm: str | None, tolerance: float, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler = th.compile
    monkeypatch.setattr(th, "compile", lambda function, **kwargs: compiler(function, backend=backend, **kwargs))
    gradients = []
    for compiled in (False, True):
        policy_kwargs = {"critic_norm": norm}
        model = filled_model(precision=precision, compile=compiled, policy_delay=1, policy_kwargs=policy_kwargs)
        np.random.seed(1)
        th.manual_seed(1)
        model.train(1, batch_size=64)
        trained = [*model.critic.parameters(), *model.actor.own_parameters(), *model.aux_head.parameters()]
        gradients.append(th.cat([parameter.grad.flatten() for parameter in trained]))
    assert (gradients[0] - gradients[1]).norm() < tolerance * gradients[0].norm()
    model.save(tmp_path / "model")
    assert type(model).load(tmp_path / "model").compile


@pytest.mark.slow
@pytest.mark.parametrize("given", [{}, {"foreach": True}, {"fused": False}, {"eps": 1e-3}], ids=str)
def test_adam_is_fused_unless_the_user_says_how(given: dict[str, Any]) -> None:
    model = make_model(policy_kwargs={"optimizer_kwargs": given})
    for optimizer in (model.actor.optimizer, model.critic.optimizer, model.aux_optimizer):
        assert optimizer.defaults["fused"] == (given.get("fused") if {"foreach", "fused"} & set(given) else True)
        assert optimizer.defaults["eps"] == given.get("eps", 1e-8)
    model = make_model(policy_kwargs={"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.5}})
    for optimizer in (model.actor.optimizer, model.critic.optimizer, model.aux_optimizer):
        assert type(optimizer) is th.optim.AdamW and optimizer.param_groups[0]["weight_decay"] == 0.5
    identity = {"features_extractor_class": "identity", "features_extractor_kwargs": {}}
    assert not make_model(policy_kwargs=identity, aux_loss=None).critic.optimizer.defaults["fused"]


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_on_a_gpu(kind: str, precision: str) -> None:
    model = make_model(kind, device="cuda", precision=precision).learn(60)
    assert model._n_updates == 40 and np.isfinite(model.logger.name_to_value["train/aux_loss"])
