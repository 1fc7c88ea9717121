"""Encoders against naive forward passes, and their initialisation."""

from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from scipy.signal import correlate
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn
from torch.nn import functional as F

from sb3_aarl import SACAux
from sb3_aarl.encoders import MLP, DenseMLP, MultiInputEncoder, PixelEncoder, RunningNorm, SimbaEncoder


def images(channels: int, height: int, width: int) -> spaces.Box:
    return spaces.Box(0, 255, (channels, height, width), np.uint8)


def vectors(*shape: int) -> spaces.Box:
    return spaces.Box(-1, 1, shape, np.float32)


def randomize(module: nn.Module, seed: int = 0) -> None:
    """Parameters that hide nothing: biases are not zero, kernels not a delta."""
    generator = th.Generator().manual_seed(seed)
    for parameter in module.parameters():
        parameter.data = th.randn(parameter.shape, generator=generator) * 0.5


def arrays(module: nn.Module) -> list[np.ndarray]:
    return [parameter.detach().double().numpy() for parameter in module.parameters()]


def naive_projection(x: np.ndarray, parameters: list[np.ndarray], tanh: bool = False) -> np.ndarray:
    weight, bias, scale, shift = parameters
    x = x @ weight.T + bias
    centred = x - x.mean(axis=1, keepdims=True)
    x = centred / np.sqrt((centred**2).mean(axis=1, keepdims=True) + 1e-5) * scale + shift
    return np.tanh(x) if tanh else x


def test_the_papers_sizes() -> None:
    encoder = PixelEncoder(images(9, 84, 84))
    assert encoder.trunk_dim == 32 * 35 * 35 and encoder.features_dim == 50
    convolutions = [layer for layer in encoder.convolutions if isinstance(layer, nn.Conv2d)]
    assert [(layer.in_channels, layer.out_channels, layer.kernel_size, layer.stride) for layer in convolutions] == [
        (9, 32, (3, 3), (2, 2)),
        *[(32, 32, (3, 3), (1, 1))] * 3,
    ]
    dense = DenseMLP(vectors(17))
    assert [tuple(layer.weight.shape) for layer in dense.layers] == [(40, 17)]
    assert (dense.trunk_dim, dense.features_dim) == (57, 40)


@pytest.mark.parametrize("tanh", [False, True])
@pytest.mark.parametrize("n_layers, n_filters, size", [(4, 3, (16, 19)), (1, 4, (5, 6)), (2, 2, (9, 8))])
def test_pixel_encoder_against_naive_convolutions(n_layers: int, n_filters: int, size: tuple[int, int], tanh: bool) -> None:
    space = images(2, *size)
    encoder = PixelEncoder(space, 5, n_layers, n_filters, tanh)
    randomize(encoder)
    observations = preprocess_obs(th.as_tensor(np.stack([space.sample() for _ in range(2)])), space)
    x = observations.double().numpy()
    parameters = arrays(encoder.convolutions)
    for layer, (weight, bias) in enumerate(zip(parameters[::2], parameters[1::2], strict=True)):
        step = 2 if layer == 0 else 1
        x = np.stack([[correlate(image, kernel, "valid")[0, ::step, ::step] for kernel in weight] for image in x])
        x = np.maximum(x + bias[None, :, None, None], 0)
    flat = np.moveaxis(x, 1, -1).reshape(len(x), -1)  # channels last
    np.testing.assert_allclose(encoder.trunk(observations).detach(), flat, rtol=1e-4, atol=1e-5)
    expected = naive_projection(flat, arrays(encoder.projection), tanh)
    np.testing.assert_allclose(encoder(observations).detach(), expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("size, n_layers", [((14, 84), 4), ((84, 14), 4), ((12, 12), 4), ((2, 9), 1)])
def test_images_that_are_too_small(size: tuple[int, int], n_layers: int) -> None:
    with pytest.raises(ValueError, match=rf"\(3, {size[0]}, {size[1]}\) are too small for {n_layers} convolutions"):
        PixelEncoder(images(3, *size), n_layers=n_layers)


def assert_orthogonal(matrix: np.ndarray, gain: float = 1.0) -> None:
    """Rows or columns, whichever are fewer, are orthogonal to each other and of one length."""
    rows, columns = matrix.shape
    gram = matrix @ matrix.T if rows <= columns else matrix.T @ matrix
    np.testing.assert_allclose(gram, gain**2 * np.eye(len(gram)), atol=1e-5)


@pytest.mark.parametrize(
    "encoder",
    [
        PixelEncoder(images(3, 15, 17), 7, n_filters=5),
        PixelEncoder(images(9, 15, 15), 50, n_filters=4),
        DenseMLP(vectors(6), 9, n_layers=3, width=5),
        MLP(vectors(6), 9, n_layers=3, width=5),
        MultiInputEncoder(spaces.Dict(a=images(3, 15, 15), b=vectors(4)), 6, 5),
    ],
    ids=lambda encoder: type(encoder).__name__,
)
def test_initialisation(encoder: nn.Module) -> None:
    seen = set()
    for layer in encoder.modules():
        if isinstance(layer, nn.Conv2d):
            weight = layer.weight.detach().numpy()
            # Delta-orthogonal: with the gain of ReLU in the middle, nothing around it.
            assert_orthogonal(weight[:, :, 1, 1], np.sqrt(2))
            weight = weight.copy()
            weight[:, :, 1, 1] = 0
            assert not weight.any()
        elif isinstance(layer, nn.Linear):
            assert_orthogonal(layer.weight.detach().numpy())
        else:
            continue
        assert not layer.bias.any()
        seen.add(type(layer))
    assert nn.Linear in seen


@pytest.mark.parametrize("cls", [DenseMLP, MLP])
@pytest.mark.parametrize("shape, n_layers, width", [((5,), 1, 4), ((3,), 4, 3), ((2, 3), 2, 5)])
def test_mlps_against_a_naive_forward_pass(cls: type[DenseMLP], shape: tuple[int, ...], n_layers: int, width: int) -> None:
    encoder = cls(vectors(*shape), 6, n_layers, width)
    randomize(encoder)
    observations = th.randn(7, *shape)
    x = observations.double().numpy().reshape(7, -1)
    parameters = arrays(encoder.layers)
    assert len(parameters) == 2 * n_layers
    for weight, bias in zip(parameters[::2], parameters[1::2], strict=True):
        added = np.maximum(x @ weight.T + bias, 0)
        x = np.concatenate([x, added], axis=1) if cls is DenseMLP else added
    assert encoder.trunk_dim == x.shape[1]
    np.testing.assert_allclose(encoder.trunk(observations).detach(), x, rtol=1e-4, atol=1e-5)
    expected = naive_projection(x, arrays(encoder.projection))
    np.testing.assert_allclose(encoder(observations).detach(), expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("kind", [DenseMLP, MLP, SimbaEncoder])
def test_a_dict_is_read_as_one_vector(kind: type[DenseMLP]) -> None:
    space = spaces.Dict(a=vectors(2, 3), b=vectors(4))
    encoder, flat = kind(space).eval(), kind(vectors(10)).eval()
    flat.load_state_dict(encoder.state_dict())
    x = th.randn(5, 10)
    parts = {"b": x[:, 6:], "a": x[:, :6].reshape(5, 2, 3)}  # as an environment may order them
    th.testing.assert_close(encoder(parts), flat(x))


@pytest.mark.parametrize(
    "keys",
    [["camera", "vectors", "speed", "mode", "joints"], ["camera"], ["speed", "joints"]],
    ids=["both", "images only", "vectors only"],
)
@pytest.mark.parametrize(("name", "vector_encoder"), [("dense_mlp", DenseMLP), ("simba", SimbaEncoder)])
def test_multi_input_encoder_is_its_parts_side_by_side(
    keys: list[str], name: str, vector_encoder: type[BaseFeaturesExtractor]
) -> None:
    everything = {
        "speed": vectors(3),
        "camera": images(3, 15, 16),
        "mode": spaces.Discrete(4),
        "vectors": images(1, 17, 15),
        "joints": vectors(2, 2),
    }
    space = spaces.Dict({key: everything[key] for key in keys})
    encoder = MultiInputEncoder(space, cnn_output_dim=5, mlp_output_dim=4, vector_encoder=name).eval()
    randomize(encoder)
    batch = {key: th.as_tensor(np.stack([part.sample() for _ in range(3)])) for key, part in space.spaces.items()}
    observations = preprocess_obs(batch, space)
    assert isinstance(observations, dict)

    # Each image on its own, all that is no image as one flat vector, in the space's order.
    inputs = [observations[key] for key in space.spaces if key in ("camera", "vectors")]
    flat = [observations[key].reshape(3, -1) for key in space.spaces if key not in ("camera", "vectors")]
    inputs += [th.cat(flat, dim=1)] if flat else []
    kinds = [PixelEncoder if x.ndim == 4 else vector_encoder for x in inputs]
    assert [type(part) for part in encoder.encoders] == kinds
    trios = zip(encoder.projection.parts, encoder.encoders, inputs, strict=True)
    expected = [projection(part.trunk(x)) for projection, part, x in trios]
    widths = {PixelEncoder: 5, SimbaEncoder: 4 + inputs[-1].shape[1]}  # simba's latent state contains the observation
    assert [latent.shape[1] for latent in expected] == [widths.get(kind, 4) for kind in kinds]

    latents = encoder(observations)
    th.testing.assert_close(latents, th.cat(expected, dim=1), rtol=1e-6, atol=1e-6)
    assert latents.shape == (3, encoder.features_dim)
    trunk = encoder.trunk(observations)
    assert th.equal(trunk, th.cat([part.trunk(x) for part, x in zip(encoder.encoders, inputs, strict=True)], dim=1))
    assert trunk.shape == (3, encoder.trunk_dim)
    assert encoder.make_projection()(trunk).shape == latents.shape


def test_simba_is_its_formula() -> None:
    encoder = SimbaEncoder(vectors(3), features_dim=4, observation=False)
    randomize(encoder)
    encoder.eval()
    x = th.randn(6, 3)
    norm, (linear, block, last) = encoder.normalization, encoder.layers
    assert isinstance(norm, RunningNorm)
    h = linear((x - norm.running_mean) / (norm.running_var + 1e-5) ** 0.5)
    inner = F.layer_norm(h, (4,), block.layers[0].weight, block.layers[0].bias)
    h = h + F.linear(F.linear(inner, *block.layers[1].parameters()).relu(), *block.layers[3].parameters())
    th.testing.assert_close(encoder(x), F.layer_norm(h, (4,), last.weight, last.bias))


def test_the_observation_beside_the_latent_state() -> None:
    encoder = SimbaEncoder(vectors(3), features_dim=4).eval()
    x = th.randn(5, 3)
    assert encoder.features_dim == 7 and th.equal(encoder(x)[:, 4:], encoder.normalization(x))
    assert th.equal(encoder(x)[:, :4], encoder.layers(encoder.normalization(x)))


def test_running_statistics_are_those_of_the_batches() -> None:
    """Those of all observations of up to a thousand batches; where no gradient is computed nothing is learnt."""
    norm, batches = RunningNorm(2), [th.randn(5, 2) * 3 + i for i in range(20)]
    for batch in batches:
        norm(batch)
        with th.no_grad():
            norm(batch + 100)
    norm.eval()
    norm(batches[0] + 100)
    th.testing.assert_close(norm.running_mean, th.cat(batches).mean(dim=0))
    th.testing.assert_close(norm.running_var, th.cat(batches).var(dim=0, unbiased=False))
    clipped = RunningNorm(2)
    clipped(th.ones(5, 2))
    assert clipped.eval()(th.tensor([[2.0, 0.0]])).tolist() == [[10, -10]]  # as VecNormalize clips
    largest = th.tensor([[1.0, th.finfo(th.float32).max], [2.0, 0.0]])
    for _ in range(2):
        assert clipped.train()(largest).isfinite().all()


def test_running_statistics_are_shared_saved_and_not_learnt_from_predictions(tmp_path: Path) -> None:
    policy = {"features_extractor_class": "simba", "features_extractor_kwargs": {"features_dim": 8}, "net_arch": [8]}
    model = SACAux(
        "MlpPolicy", "Pendulum-v1", learning_starts=10, batch_size=4, policy_kwargs=policy, target_update_interval=5
    )

    def statistics(some: SACAux) -> list[th.Tensor]:
        encoders = some.critic.features_extractor, some.critic_target.features_extractor
        found = [[buffer.clone() for buffer in encoder.buffers()] for encoder in encoders]
        assert all(th.equal(one, other) for others in found[1:] for one, other in zip(found[0], others, strict=True))
        return found[0]

    for steps in (11, 1, 1, 1):  # the target's parameters follow every fifth step, its statistics always
        model.policy.double().float()  # replaces the tensors of statistics, as a move to a GPU does
        model.learn(steps, reset_num_timesteps=False)
        before = statistics(model)
    assert before[-1] > 0
    model.predict(np.full((7, 3), 50.0, np.float32))
    model.save(tmp_path / "model")
    for some in (model, SACAux.load(tmp_path / "model")):
        assert all(th.equal(one, other) for one, other in zip(before, statistics(some), strict=True))
