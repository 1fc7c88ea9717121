"""The gradient step in bfloat16, as a CUDA graph, with fused optimizers, from storage elsewhere: still the same step."""

import contextlib
import copy
import gc
import logging
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch as th
from test_sac_aux import KINDS, LOSS, assert_same, everything, filled_model, make_model
from torch.optim import adam
from torch.utils._python_dispatch import TorchDispatchMode, _get_current_dispatch_mode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from sb3_aarl import cuda_graph, sac_aux
from sb3_aarl.aux_loss import OPERATORS
from sb3_aarl.cuda_graph import GraphedStep, _key, _leaves, _map, unchecked_distributions
from sb3_aarl.policies import Critic
from sb3_aarl.sac_aux import NonFiniteError

PRODUCTS = {"aten.mm", "aten.addmm", "aten.convolution", "aten.convolution_backward"}
needs_cuda = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a CUDA device")


def assert_near(given: dict[str, Any], expected: dict[str, Any], **tolerances: float) -> None:
    for name, value in expected.items():
        if isinstance(value, th.Tensor):
            th.testing.assert_close(given[name], value, **tolerances)


class Operations(TorchDispatchMode):
    """The data types that operations were given, by name."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: dict[str, set[th.dtype]] = {}

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        inputs = {arg.dtype for arg in args if isinstance(arg, th.Tensor) and arg.is_floating_point()}
        self.seen.setdefault(str(function).rpartition(".")[0], set()).update(inputs)
        return function(*args, **(kwargs or {}))


def test_bfloat16_without_instructions_for_it_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    flags = (
        re.search(r"^flags\s*:(.*)", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        if Path("/proc/cpuinfo").exists()
        else None
    )
    if flags is not None and "avx_ne_convert" not in flags[1]:  # Linux on x86; with that one it depends on the version
        assert sac_aux._computes_bf16(th.device("cpu")) == ({"avx512bw", "avx512vl", "avx512dq"} <= set(flags[1].split()))
    for computes, precision, told in ((False, "bf16", True), (True, "bf16", False), (False, "fp32", False)):
        monkeypatch.setattr(sac_aux, "_computes_bf16", lambda device, computes=computes: computes)
        caplog.clear()
        make_model(precision=precision)
        expected = ["precision='bf16': this CPU has no instructions for it, fp32 is faster"] * told
        assert [record.getMessage() for record in caplog.records] == expected


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


@pytest.mark.parametrize("kind", KINDS)
def test_bfloat16_gives_almost_the_same_gradients(kind: str) -> None:
    of_encoders = []  # by how much the lengths of their gradients differ: mostly little, but in one of five networks by 5 %
    for seed in range(5):
        gradients, logs = [], []
        for precision in ("fp32", "bf16"):
            rates: dict[str, float] = {"learning_rate": 0.0, "encoder_learning_rate": 0.0, "ent_coef_learning_rate": 0.0}
            model = filled_model(kind, precision=precision, policy_delay=1, seed=seed, **rates)
            model.train(1, batch_size=128)
            trained = {
                "encoder": model.critic.features_extractor.parameters(),
                "q": model._q_parameters(model.critic),
                "actor": model.actor.own_parameters(),
                "head": model.aux_head.parameters(),
                "ent_coef": [model.log_ent_coef],
            }
            gradients.append({name: th.cat([p.grad.flatten() for p in those]) for name, those in trained.items()})
            logs.append({key: value for key, value in model.logger.name_to_value.items() if "loss" in key})
        for name, exact in gradients[0].items():
            assert th.cosine_similarity(exact, gradients[1][name], dim=0) > 0.995, name
            assert not th.equal(exact, gradients[1][name])
            if name == "encoder":
                of_encoders.append(abs(exact.norm().item() / gradients[1][name].norm().item() - 1))
            else:
                assert exact.norm().item() == pytest.approx(gradients[1][name].norm().item(), rel=0.02), name
        for name, value in logs[0].items():
            assert logs[1][name] == pytest.approx(value, rel=0.02, abs=1e-3), name
    assert np.median(of_encoders) < 0.02


def test_bfloat16_predicts_and_is_saved_in_float32(tmp_path: Any) -> None:
    model = make_model(precision="bf16").learn(60)
    model.save(tmp_path / "model")
    exact = type(model).load(tmp_path / "model", precision="fp32", device="cpu")
    assert exact.precision == "fp32"
    observations = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    assert_same(model.predict(observations, deterministic=True)[0], exact.predict(observations, deterministic=True)[0])


def test_bfloat16_learns_as_float32_does() -> None:
    """The auxiliary loss and the critic loss after some hundred steps on the same data."""
    found: dict[str, list[float]] = {"fp32": [], "bf16": []}
    for precision, values in found.items():
        model = filled_model(steps=280, precision=precision, learning_rate=1e-3)
        model.train(5, batch_size=64)
        before = dict(model.logger.name_to_value)
        model.train(300, batch_size=64)
        model.train(50, batch_size=64)
        after = model.logger.name_to_value
        assert after["train/aux_loss"] < 0.5 * before["train/aux_loss"]
        values += [after["train/aux_loss"], after["train/critic_loss"]]
    assert found["bf16"] == pytest.approx(found["fp32"], rel=0.3)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("n_critics", [1, 2, 3])
def test_the_actor_loss_leaves_out_critics_that_are_not_the_smallest(n_critics: int, precision: str) -> None:
    model = filled_model(policy_kwargs={"n_critics": n_critics})
    n_features = model.critic.features_extractor.features_dim
    inputs = [th.randn(64, size, requires_grad=True) for size in (n_features, model.action_space.shape[0])]
    found: list[tuple[th.Tensor, ...]] = []
    work: list[int] = []
    for skip_rows in (False, True):
        with th.autocast("cpu", th.bfloat16, enabled=precision == "bf16"):
            values = model.critic.min_q_values(*inputs, skip_rows)
        with FlopCounterMode(display=False) as counter:
            found.append((values, *th.autograd.grad(values.square().sum(), inputs, retain_graph=True)))
        work.append(counter.get_total_flops())
    assert work[0] == n_critics * work[1] > 0
    for expected, given in zip(*found, strict=True):
        assert_same(given.dtype, expected.dtype)
        scale = expected.abs().max().item()
        th.testing.assert_close(given, expected, rtol=0, atol=scale * (1e-6 if precision == "fp32" else 1e-2))
    values.sum().backward()
    assert all(parameter.grad is None for parameter in model.critic.parameters())


def test_networks_that_a_user_changed_are_called_as_they_are() -> None:
    for change in ("hook", "norm", "layer"):
        critic = filled_model().critic
        latent, actions = th.randn(8, critic.features_extractor.features_dim), th.rand(8, 2)
        actions = actions[:, : critic.q_networks[0][0].in_features - latent.shape[1]]
        before = critic.min_q_values(latent, actions, True)
        first = critic.q_networks[0]
        if change == "hook":
            first[0].register_forward_hook(lambda module, inputs, output: output + 1)
        elif change == "norm":
            th.nn.utils.parametrizations.spectral_norm(first[0])
        else:
            first[0] = type("Doubled", (th.nn.Linear,), {"forward": lambda self, x: 2 * x @ self.weight.T})(
                first[0].in_features, first[0].out_features
            )
        th.manual_seed(0)
        least = th.cat(critic.q_values(latent, actions), dim=1).amin(dim=1, keepdim=True)
        assert_same(critic.min_q_values(latent, actions, True).detach(), least.detach())
        assert not th.equal(before, least)


@pytest.mark.parametrize("given", [{}, {"foreach": True}, {"fused": False}, {"eps": 1e-3}], ids=str)
def test_adam_is_fused_unless_the_user_says_how(given: dict[str, Any]) -> None:
    model = make_model(policy_kwargs={"optimizer_kwargs": given})
    for optimizer in (model.actor.optimizer, model.critic.optimizer, model.aux_optimizer):
        assert optimizer.defaults["fused"] == (given.get("fused") if {"foreach", "fused"} & set(given) else True)
        assert optimizer.defaults["eps"] == given.get("eps", 1e-8)
    assert "fused" not in given or given == {"fused": False}  # the user's dict is not written to
    identity = {"features_extractor_class": "identity", "features_extractor_kwargs": {}}
    assert not make_model(policy_kwargs=identity, aux_loss=None).critic.optimizer.defaults["fused"]
    momentum = {"optimizer_class": th.optim.SGD, "optimizer_kwargs": {"momentum": 0.5}}
    assert isinstance(make_model(policy_kwargs=momentum).critic.optimizer, th.optim.SGD)


def test_cuda_graphs_without_cuda_are_one_line_of_log(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        graphed = make_model(compile="cudagraphs").learn(60)
    assert [record.getMessage() for record in caplog.records] == [
        "compile='cudagraphs' needs a CUDA device, not cpu: the gradient step runs as without"
    ]
    assert_same(everything(graphed), everything(make_model().learn(60)))


def test_tf32_is_allowed_in_training_only() -> None:
    before = th.backends.cuda.matmul.allow_tf32, th.backends.cudnn.allow_tf32
    for allowed in (True, False, None):
        model = filled_model(allow_tf32=allowed)
        seen = []
        model.aux_head.register_forward_hook(
            lambda *_, seen=seen: seen.append((th.backends.cuda.matmul.allow_tf32, th.backends.cudnn.allow_tf32))
        )
        model.train(2, batch_size=16)
        assert seen == [before if allowed is None else (allowed, allowed)] * 2
        assert (th.backends.cuda.matmul.allow_tf32, th.backends.cudnn.allow_tf32) == before


def test_a_loss_that_is_found_not_finite_afterwards_names_its_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a GPU losses are looked at when all gradient steps are done."""
    model = filled_model()
    step, calls = model._gradient_step, []

    def third_is_infinite(*arguments: Any) -> dict[str, th.Tensor]:
        logs = step(*arguments)
        calls.append(logs)
        return logs | ({"critic_loss": th.tensor(float("inf"))} if len(calls) == 3 else {})

    monkeypatch.setattr(model, "_gradient_step", third_is_infinite)
    with pytest.raises(NonFiniteError, match=r"critic_loss is inf at gradient step 3, .*auxiliary loss: \{s_t"):
        model.train(5, batch_size=16)
    assert len(calls) == 5


@pytest.mark.parametrize("kind", KINDS)
def test_frames_in_a_tensor_give_the_same_training(kind: str) -> None:
    """The storage of a GPU, on the CPU."""
    plain = make_model(kind).learn(60)
    there = make_model(kind, replay_buffer_kwargs={"storage_device": "cpu"}).learn(60)
    assert isinstance(next(iter(there.replay_buffer.stores.values())).frames, th.Tensor)
    assert_same(everything(there), everything(plain))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("loss", [LOSS, *(f"{{s_t, a_t}} -> {{s_t+1, r_t}} [{name}, negatives]" for name in OPERATORS)])
def test_no_gradient_step_waits_for_a_gpu(kind: str, loss: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """
    On PyTorch's meta device tensors have no values: whatever asks for one, as it would wait for a GPU, fails. So does whatever
    mixes tensors of two devices.
    """
    # Adam fused or capturable there is not.
    kwargs = {"policy_kwargs": {"optimizer_kwargs": {"foreach": True}}, "replay_buffer_kwargs": {"storage_device": "meta"}}
    model = filled_model(kind, device="meta", aux_loss=loss, **kwargs)
    autocast = th.autocast
    monkeypatch.setattr(th, "autocast", lambda device, *args, **kwargs: autocast("cpu", *args, **kwargs))
    for update_actor, update_target in ((False, False), (True, False), (False, True), (True, True)):
        for _ in range(5):  # ends of episodes are in some of the batches only
            batch, windows = model._draw(16)
        assert {tensor.device.type for tensor in _leaves((batch, windows))} == {"meta"}
        with unchecked_distributions():
            logs = model._gradient_step(batch, windows, update_actor, update_target)
        assert ("actor_loss" in logs) == update_actor
        assert {"critic_loss", "aux_loss", "aux_grad_norm"} <= logs.keys()
        assert {value.device.type for value in logs.values()} == {"meta"}
    for read in (lambda: logs["aux_loss"].item(), lambda: logs["aux_loss"].cpu(), lambda: bool(logs["aux_loss"] > 0)):
        with pytest.raises((RuntimeError, NotImplementedError)):
            read()


def test_what_a_recording_depends_on() -> None:
    model = filled_model("dict")
    batch, windows = model._draw(16)
    arguments = (batch, windows, True, False)
    copied = _map(th.clone, arguments)
    assert type(copied[0]) is type(batch) and type(copied[1]) is type(windows) and copied[2:] == (True, False)
    leaves = list(_leaves(arguments))
    assert len(leaves) == 2 + 2 + 3 + 2 + 2  # two keys of both observations, actions, dones, rewards; of windows
    for one, other in zip(leaves, _leaves(copied), strict=True):
        assert one is not other and th.equal(one, other)
    assert _key(arguments) == _key(copied) == _key((*model._draw(16), True, False))
    others = [(batch, windows, False, False), (batch, None, True, False), (*model._draw(15), True, False)]
    assert len({_key(arguments), *map(_key, others)}) == 4


def test_a_model_whose_images_were_laid_out_in_another_way_is_refused() -> None:
    model = make_model("pixels")
    parameters = model.get_parameters()
    model.set_parameters(parameters)
    for key, metadata in parameters["policy"]._metadata.items():
        assert metadata["version"] == (2 if key.endswith("features_extractor") else 1)
        metadata["version"] = 1
    with pytest.raises(RuntimeError, match="saved by a version of sb3-aarl that laid images out in another way"):
        model.set_parameters(parameters)


class Tape(TorchDispatchMode):
    """
    What a CUDA graph is, of operations on the CPU: those in its context are taken down and, unlike a GPU's, done and undone.
    A replay does them again on the very same tensors, so that whatever Python decided in between stays as it was.
    """

    def __init__(self) -> None:
        super().__init__()
        self.operations: list[tuple[Any, Any, Any, Any]] = []
        self.before: dict[int, tuple[th.Tensor, th.Tensor]] = {}

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        for argument, value in zip(function._schema.arguments, args, strict=False):
            if argument.alias_info is not None and argument.alias_info.is_write:
                for tensor in tree_leaves(value):
                    self.before.setdefault(id(tensor), (tensor, tensor.clone()))
        result = function(*args, **kwargs)
        self.operations.append((function, args, kwargs, result))
        return result

    def __enter__(self) -> Any:
        self.random_state = th.get_rng_state()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        for tensor, before in reversed(self.before.values()):
            tensor.detach().copy_(before)
        th.set_rng_state(self.random_state)

    @th.no_grad()
    def replay(self) -> None:
        for function, args, kwargs, result in self.operations:
            for old, new in zip(tree_leaves(result), tree_leaves(function(*args, **kwargs)), strict=True):
                if isinstance(old, th.Tensor) and old.data_ptr() != new.data_ptr():  # neither a view nor what was written to
                    old.detach().copy_(new)


@pytest.fixture
def tapes(monkeypatch: pytest.MonkeyPatch) -> None:
    """``compile="cudagraphs"`` on the CPU, with tapes in place of graphs."""
    for name in ("device", "stream"):
        monkeypatch.setattr(th.cuda, name, lambda *arguments: contextlib.nullcontext())
    for name in ("Stream", "current_stream"):
        monkeypatch.setattr(th.cuda, name, lambda *arguments: SimpleNamespace(wait_stream=lambda other: None))
    monkeypatch.setattr(th.cuda, "CUDAGraph", Tape)
    monkeypatch.setattr(th.cuda, "graph", lambda graph, stream: graph)
    monkeypatch.setattr(adam, "_get_capturable_supported_devices", lambda: ["cpu"])
    # As on a GPU: which rows have a gradient is data that Python would look at.
    plain = Critic.min_q_values
    monkeypatch.setattr(Critic, "min_q_values", lambda self, *inputs, skip_rows: plain(self, *inputs, skip_rows=False))


def taped_model(kind: str = "state", **kwargs: Any) -> Any:
    model = filled_model(kind, **kwargs)
    model._graphed_step = GraphedStep(model._gradient_step, model.device)
    return model


@pytest.mark.usefixtures("tapes")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"precision": "bf16"},
        {"joint_optimizer": True},
        {"ent_coef": 0.1},
        {"policy_delay": 3, "target_update_interval": 2},
    ],
    ids=str,
)
def test_a_recorded_step_is_the_eager_step(kind: str, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Over 30 steps; nothing that changes from step to step, as the learning rate, is recorded as a number."""
    states, logs = [], []
    for warmup_steps in (1000, cuda_graph.WARMUP_STEPS):
        monkeypatch.setattr(cuda_graph, "WARMUP_STEPS", warmup_steps)
        model = taped_model(kind, learning_rate=lambda left: 1e-3 * left, **settings)
        np.random.seed(0)
        th.manual_seed(0)
        for i in range(10):
            model._current_progress_remaining = 1 - i / 20
            model.train(3, batch_size=16)
        for optimizer, schedule in model._optimizers().items():
            assert optimizer.param_groups[0]["lr"].item() == pytest.approx(schedule(1 - i / 20))
        states.append(copy.deepcopy(everything(model)))
        logs.append(dict(model.logger.name_to_value))
    assert model._graphed_step.works and len(model._graphed_step.recordings) >= 2
    assert len(model._graphed_step.recordings) == len(model._graphed_step.seen)
    assert_same(logs[1], logs[0])
    assert_same(states[1], states[0])


@pytest.mark.usefixtures("tapes")
def test_parameters_that_are_set_reach_what_is_recorded() -> None:
    eager, taped = filled_model(), taped_model()
    for model in (eager, taped):
        model.train(12, batch_size=16)
    assert taped._graphed_step.recordings
    parameters = copy.deepcopy(eager.get_parameters())
    for model in (eager, taped):
        model.set_parameters(parameters)
        np.random.seed(0)
        th.manual_seed(0)
        model.train(12, batch_size=16)
    assert_near(everything(taped), everything(eager), rtol=1e-4, atol=1e-5)


@pytest.mark.usefixtures("tapes")
@pytest.mark.parametrize("is_known", [False, True])  # whether CUDA knows that the recording was broken off
def test_what_cannot_be_recorded_runs_as_it_is(
    is_known: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Broken(Tape):
        def __exit__(self, *error: Any) -> None:
            super().__exit__(*error)
            if error[0] is not None and is_known:
                raise RuntimeError("a recording was broken off")

    monkeypatch.setattr(th.cuda, "CUDAGraph", Broken)
    model, eager = taped_model(), filled_model()
    step = model._gradient_step

    def waits(*arguments: Any) -> dict[str, th.Tensor]:
        logs = step(*arguments)
        if isinstance(_get_current_dispatch_mode(), Broken):
            raise RuntimeError("somebody waits\nfor the GPU")
        return logs

    model._graphed_step.step = waits
    for each in (model, eager):
        np.random.seed(0)
        th.manual_seed(0)
        try:
            raise ValueError("an earlier training diverged")
        except ValueError:
            each.train(12, batch_size=16)
    assert [record.getMessage() for record in caplog.records] == [
        "No CUDA graph, the gradient step runs kernel by kernel: somebody waits"
    ]
    assert gc.isenabled()
    assert_near(everything(model), everything(eager), rtol=1e-4, atol=1e-5)


def test_two_models_with_one_s_parameters_go_on_by_themselves() -> None:
    one, other = filled_model(), filled_model()
    one.train(4, batch_size=16)
    other.set_parameters(one.get_parameters())
    before = everything(one)
    other.train(4, batch_size=16)
    assert_same(everything(one), before)


@needs_cuda
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_a_cuda_graph_is_the_eager_step(kind: str, precision: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over 20 steps with the same data and the same noise; also with a learning rate that changes."""
    monkeypatch.setattr(th.backends.cudnn, "deterministic", True)
    states = []
    for mode in (None, "cudagraphs"):
        model = filled_model(
            kind, precision=precision, compile=mode, device="cuda", learning_rate=lambda left: 1e-3 * left, allow_tf32=False
        )
        np.random.seed(0)
        th.manual_seed(0)
        for i in range(20):
            model._current_progress_remaining = 1 - i / 40
            model.train(1, batch_size=16)
        states.append(copy.deepcopy(everything(model)))
        assert mode is None or (model._graphed_step.works and model._graphed_step.recordings)
    assert_near(states[1], states[0], rtol=1e-2, atol=1e-3)


@needs_cuda
def test_parameters_that_are_set_reach_the_graph() -> None:
    models = [filled_model(compile=mode, device="cuda", allow_tf32=False) for mode in (None, "cudagraphs")]
    for model in models:
        model.train(12, batch_size=16)
    parameters = copy.deepcopy(models[0].get_parameters())
    for model in models:
        model.set_parameters(parameters)
        np.random.seed(0)
        th.manual_seed(0)
        model.train(12, batch_size=16)
    assert_near(everything(models[1]), everything(models[0]), rtol=1e-2, atol=1e-3)


@needs_cuda
def test_storage_on_the_gpu() -> None:
    model = make_model("pixels", device="cuda", replay_buffer_kwargs={"storage_device": "cuda"}).learn(60)
    model.learn(20)  # begins with a reset that nobody was told of
    batch, windows = model._draw(16)
    assert batch.observations.is_cuda and windows.observations.is_cuda
    assert model.replay_buffer.stores[""].frames.is_cuda
