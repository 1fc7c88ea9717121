"""AuxLoss: notation, validity, canonical form and the size of the search space."""

import dataclasses
import pickle

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from test_space import losses

from sb3_aarl import AuxLoss
from sb3_aarl.aux_loss import Token

# A busy machine is no failure.
relaxed = settings(deadline=None, max_examples=50)


def as_sets(loss: AuxLoss) -> tuple[set[tuple[str, int]], set[tuple[str, int]]]:
    """Source and target as sets of (kind, offset), read from the bits alone."""
    source, target = ({("sar"[i % 3], i // 3) for i, bit in enumerate(mask) if bit} for mask in (loss.source, loss.target))
    return source, target


def smallest_horizon(tokens: set[tuple[str, int]]) -> int:
    return max([1] + [offset if kind == "s" else offset + 1 for kind, offset in tokens])


@relaxed
@given(losses(max_horizon=12))
def test_notation_round_trip(loss: AuxLoss) -> None:
    assert AuxLoss.parse(str(loss)) == loss
    assert AuxLoss.parse(loss.latex(), loss.operator, loss.negatives, loss.horizon) == loss
    # What is said twice alike is no contradiction.
    assert AuxLoss.parse(str(loss), loss.operator, loss.negatives, loss.horizon) == loss


@relaxed
@given(losses(max_horizon=12))
def test_value_semantics(loss: AuxLoss) -> None:
    twin = AuxLoss(loss.horizon, list(loss.source), list(loss.target), loss.operator, loss.negatives)  # type: ignore[arg-type]
    assert twin == loss and hash(twin) == hash(loss) and len({twin, loss}) == 1
    assert pickle.loads(pickle.dumps(loss)) == loss
    for dumper in (yaml.SafeDumper, yaml.Dumper):
        assert yaml.safe_load(yaml.dump({"aux_loss": loss}, Dumper=dumper)) == {"aux_loss": str(loss)}
    with pytest.raises(dataclasses.FrozenInstanceError):
        loss.horizon = 1  # type: ignore[misc]
    for field, value in (("negatives", not loss.negatives), ("operator", "mse" if loss.operator != "mse" else "inner")):
        assert dataclasses.replace(loss, **{field: value}) != loss


@relaxed
@given(losses(max_horizon=12))
def test_tokens_are_the_bits_of_the_masks(loss: AuxLoss) -> None:
    source, target = as_sets(loss)
    assert set(loss.source_tokens) == source and set(loss.target_tokens) == target
    for tokens in (loss.source_tokens, loss.target_tokens):
        assert list(tokens) == [Token.of(i) for i in range(3 * loss.horizon + 1) if Token.of(i) in tokens]
    longer = AuxLoss.from_tokens(loss.source_tokens, loss.target_tokens, loss.operator, loss.negatives, loss.horizon)
    assert longer == loss
    shortest = AuxLoss.from_tokens(loss.source_tokens, loss.target_tokens)
    assert shortest.horizon == smallest_horizon(source | target) <= loss.horizon


@relaxed
@given(losses(max_horizon=12))
def test_canonical_against_sets(loss: AuxLoss) -> None:
    source, target = as_sets(loss)
    start = min(offset for _, offset in source | target)
    shifted = [{(kind, offset - start) for kind, offset in tokens} for tokens in (source, target)]
    canonical = loss.canonical()
    assert as_sets(canonical) == tuple(shifted)
    assert canonical.horizon == smallest_horizon(shifted[0] | shifted[1])
    assert (canonical.operator, canonical.negatives) == (loss.operator, loss.negatives)
    assert canonical.canonical() == canonical


def test_masks_that_are_typed_out() -> None:
    # s_t a_t r_t s_t+1 a_t+1 r_t+1 s_t+2
    source = (True, True, False, False, False, False, False)
    target = (False, False, False, False, False, True, True)
    loss = AuxLoss(2, source, target, "cosine", True)
    assert str(loss) == "{s_t, a_t} -> {r_t+1, s_t+2} [cosine, negatives]"
    assert loss.latex() == r"\{s_t, a_t\} \rightarrow \{r_{t+1}, s_{t+2}\}"
    assert AuxLoss.parse("{s_t, a_t} -> {r_t+1, s_t+2}") == AuxLoss(2, source, target)
    assert str(AuxLoss(2, (True,) + (False,) * 6, (True,) + (False,) * 6)) == "{s_t} -> {s_t} [horizon=2]"


@pytest.mark.parametrize(
    "text",
    [
        "{s_t, a_t}->{s_t+1}",
        "  { a_t ,s_t }  ->  { s_t + 1 }  ",
        "{s_t, a_t} → {s_{t+1}}",
        r"\{s_t, a_t\} \rightarrow \{s_{t+1}\}",
        r"$\{s_{t}, a_t\} \to \{s_{ t + 1 }\}$",
        r"$\{s_t, a_t\}$ \rightarrow $\{s_{t+1}\}$",
        r"$$\{s_t,a_{t+0}\}\rightarrow\{s_{t+01}\}$$",
        "{s_t, a_t} -> {s_t+1} [mse]",
        "{s_t, a_t} -> {s_t+1} [horizon = 1]",
    ],
)
def test_ways_to_write_forward_dynamics(text: str) -> None:
    assert AuxLoss.parse(text) == AuxLoss(1, (True, True, False, False), (False, False, False, True))


def test_arguments_and_brackets() -> None:
    text = "{s_t} -> {s_t}"
    assert AuxLoss.parse(text, "inner", True, 3) == AuxLoss.parse(f"{text} [negatives, horizon=3, inner]")
    assert AuxLoss.parse(f"{text} [n_mse]", negatives=True, horizon=2) == AuxLoss.parse(text, "n_mse", True, 2)
    with pytest.raises(ValueError, match=r"operator is 'inner', but the notation says 'cosine'"):
        AuxLoss.parse(f"{text} [cosine]", "inner")
    with pytest.raises(ValueError, match=r"horizon is 2, but the notation says 3"):
        AuxLoss.parse(f"{text} [horizon=3]", horizon=2)


@pytest.mark.parametrize(
    "text, problem",
    [
        ("", "a notation is a text such as .*, not ''"),
        ("s_t -> s_t+1", "a notation is"),
        ("{s_{t+1} -> {s_t}", "a notation is"),
        ("{s_t} {s_t}", "a notation is"),
        ("{s_t} -> {s_t", "a notation is"),
        ("{s_t} -> {s_t} -> {s_t}", "a notation is"),
        ("{s_t} -> {s_t} [mse", "a notation is"),
        ("{x_t} -> {s_t}", "'x_t' is not a token"),
        ("{,s_t} -> {s_t}", "'' is not a token"),
        ("{s_t+} -> {s_t}", r"'s_t\+' is not a token"),
        ("{s_t, s_{t+0}} -> {s_t}", "s_t appears twice"),
        ("{s_t} -> {s_t} [huber]", "'huber' is none of .*bilinear.*, negatives, horizon=k"),
        ("{s_t} -> {s_t} [mse, cosine]", "'cosine' is .* each at most once"),
        ("{s_t} -> {s_t} []", "'' is none of "),
    ],
)
def test_what_cannot_be_read_is_named(text: str, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        AuxLoss.parse(text)


YES, NO = (True, False, False, False), (False,) * 4


@pytest.mark.parametrize(
    "arguments, rule",
    [
        ((1, (False, True, True, False), YES), r"source needs at least one state.* it has a_t, r_t$"),
        ((1, NO, YES), r"source needs at least one state.* it has nothing$"),
        ((1, YES, NO), "target is empty"),
        ((1, YES[:3], YES), "source has 3 bits, but horizon 1 has 4 tokens"),
        ((1, YES, (0, 2, 0, 0)), "target must be booleans"),
        ((0, (True,), (True,)), "horizon must be an integer from 1 to 1000, not 0"),
        ((True, YES, YES), "horizon must be an integer .* not True"),
        ((1.5, YES, YES), "horizon must be an integer .* not 1.5"),
        ((1001, (True,) * 3004, (True,) * 3004), "horizon must be an integer from 1 to 1000, not 1001"),
        ((1, YES, YES, "huber"), "unknown operator 'huber', expected one of inner, bilinear, cosine, mse, n_mse"),
        ((1, YES, YES, "mse", "false"), "negatives must be a boolean, not 'false'"),
    ],
)
def test_an_invalid_loss_names_the_rule(arguments: tuple, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        AuxLoss(*arguments)


@pytest.mark.parametrize(
    "text, horizon, rule",
    [
        ("{} -> {s_t}", None, "it has nothing$"),
        ("{s_t} -> {a_t+2}", 2, r"a_t\+2 needs a horizon of at least 3, not 2"),
        ("{s_t} -> {a_t+1000}", None, "from 1 to 1000, not 1001"),
        ("{s_t} -> {s_t+99999999999}", None, "from 1 to 1000, not 99999999999"),
        ("{s_t} -> {s_t} [horizon=0]", None, "horizon must be an integer .* not 0"),
    ],
)
def test_a_readable_loss_that_is_invalid(text: str, horizon: int | None, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        AuxLoss.parse(text, horizon=horizon)


FRAGMENTS = ["{", "}", r"\{", r"\}", "->", r"\rightarrow", "s_t", "a_t", "r_{t+1}", "s_t+2", "+", "1", ",", " ", "$", "[", "]"]
FRAGMENTS += ["mse", "bilinear", "negatives", "horizon=3", "horizon=", "{s_t", "{s_t} -> {s_t+1}", "²", "\x00", "٣"]


@relaxed
@given(
    st.one_of(
        st.text(),
        st.lists(st.sampled_from(FRAGMENTS)).map("".join),
        losses(max_horizon=12)
        .map(str)
        .flatmap(
            lambda text: st.tuples(st.integers(0, len(text)), st.integers(0, 3), st.text(max_size=3)).map(
                lambda edit: text[: edit[0]] + edit[2] + text[edit[0] + edit[1] :]
            )
        ),
    )
)
def test_any_text_is_a_loss_or_a_value_error(text: str) -> None:
    try:
        loss = AuxLoss.parse(text)
    except ValueError as error:
        assert str(error)
    else:
        assert AuxLoss.parse(str(loss)) == loss
