"""The catalogue against the paper: table 1, appendix D.1 and the candidates of tables 9, 12, 13 and 14."""

import re
from pathlib import Path

import pytest

from sb3_aarl import AuxLoss, catalog

SETS = tuple[set[str], set[str]]


def as_sets(loss: AuxLoss) -> SETS:
    """Source and target as sets such as ``{"s0", "a3"}``, read from the bits alone."""
    source, target = ({f"{'sar'[i % 3]}{i // 3}" for i, bit in enumerate(mask) if bit} for mask in (loss.source, loss.target))
    return source, target


def read_latex(line: str) -> SETS:
    """The paper's own print of a candidate, by a pattern that knows nothing of AuxLoss."""
    source, target = (
        {kind + (offset or "0") for kind, offset in re.findall(r"([sar])_(?:t|\{t\+(\d+)\})", part)}
        for part in line.split(r"\rightarrow")
    )
    return source, target


@pytest.mark.parametrize(
    "name, horizon, source, target, operator, negatives",
    [
        ("forward-dynamics", 1, "s0 a0", "s1", "mse", False),
        ("inverse-dynamics", 1, "a0 s1", "s0", "mse", False),
        ("reward-prediction", 1, "s0 a0", "r0", "mse", False),
        ("action-inference", 1, "s0 s1", "a0", "mse", False),
        ("curl", 1, "s0", "s0", "bilinear", True),
        ("aarl-pixel", 4, "s1 a1 a2 a3", "r0 r1 s2 s3", "mse", False),
        ("aarl-state", 9, "s0 a0 a1 s2 a2 a3 r3 a4 r4 a5 a7 s8 a8 r8", "s1 s3 a4 s6 s9", "mse", False),
        ("spr-3", 3, "s0 a0 a1 a2", "s1 s2 s3", "n_mse", False),
        ("atc-4", 4, "s0", "s1 s2 s3 s4", "bilinear", True),
    ],
)
def test_named_losses(name: str, horizon: int, source: str, target: str, operator: str, negatives: bool) -> None:
    loss = catalog.load(name)
    assert as_sets(loss) == (set(source.split()), set(target.split()))
    assert (loss.horizon, loss.operator, loss.negatives) == (horizon, operator, negatives)
    assert catalog.resolve(name) == loss


def test_names() -> None:
    names = catalog.names()
    assert len(names) == len(set(names)) == 27
    assert names[:3] == ["aarl-pixel", "aarl-state", "action-inference"]
    for family in ("atc", "spr"):
        assert [name for name in names if name.startswith(family)] == [f"{family}-{k}" for k in range(1, 11)]
    assert all(catalog.load(name) == catalog.load(name).canonical() for name in names)
    for k in range(1, 11):
        for name, operator in ((f"atc-{k}", "bilinear"), (f"spr-{k}", "n_mse")):
            loss = catalog.load(name)
            assert (loss.horizon, loss.operator, loss.negatives) == (k, operator, operator == "bilinear")
            assert as_sets(loss)[1] == {f"s{i}" for i in range(1, k + 1)}


@pytest.mark.parametrize(
    "name, nearest",
    [
        ("crul", "curl"),
        ("CRUL", "curl"),
        ("forward-dynamic", "forward-dynamics"),
        ("aarl_pixel", "aarl-pixel"),
        ("spr-11", "spr-1"),
        ("atc", "atc-"),
        ("qqqq", "known: aarl-pixel, "),
    ],
)
@pytest.mark.parametrize("look_up", [catalog.load, catalog.resolve])
def test_unknown_names_list_the_nearest(name: str, nearest: str, look_up) -> None:
    with pytest.raises(ValueError, match=f"unknown auxiliary loss '{name}'") as error:
        look_up(name)
    assert nearest in str(error.value).partition(", ")[2]


def test_capitals_and_published_candidates() -> None:
    for name in ("AARL-State", "CURL", " curl", "Atc-3"):
        assert catalog.load(name) == catalog.load(name.strip().lower())
    assert len(catalog.published()) == 124
    assert all(catalog.resolve(name) == loss for name, loss in catalog.published().items())
    assert catalog.load("cheetah-run-state-4-4") == catalog.load("aarl-state")


def test_a_file_of_one_loss(tmp_path: Path) -> None:
    path = tmp_path / "winner.yml"
    problems = {"a: 1": "aux_loss: .*not None", "aux_loss: curll": "curl", "aux_loss: 3": "not 3", "{": "line [12]"}
    for text, problem in problems.items():
        path.write_text(text)
        with pytest.raises(ValueError, match=rf"(?s)winner.yml: .*{problem}"):
            catalog.resolve(path)
    path.write_text("aux_loss: curl")
    assert catalog.resolve(path) == catalog.resolve(str(path)) == catalog.load("curl")


def test_resolve() -> None:
    loss = AuxLoss.parse("{s_t} -> {s_t+1} [cosine, negatives]")
    assert catalog.resolve(loss) == catalog.resolve(str(loss)) == loss
    with pytest.raises(ValueError, match="a notation is"):
        catalog.resolve("s_t -> s_t+1")
    with pytest.raises(ValueError, match="not 3"):
        catalog.resolve(3)


# Of the paper's tables.
TASKS = {"9": "cheetah-run-pixel", "12": "cheetah-run-state", "13": "hopper-hop-state", "14": "quadruped-run-state"}


def test_shape_of_the_published_tables() -> None:
    published = catalog.published()
    sizes = {"9": [5] * 7, "12": [5] * 7, "13": [5, 5, 4, 5, 5, 5], "14": [5] * 5}
    assert list(published) == [
        f"{TASKS[table]}-{generation}-{rank}"
        for table in sizes
        for generation, ranks in enumerate(sizes[table], start=1)
        for rank in range(1, ranks + 1)
    ]
    for loss in published.values():
        # Table 2's choice for all of them; the paper prints each from t on with the horizon left to the reader.
        assert (loss.operator, loss.negatives) == ("mse", False)
        assert loss == loss.canonical()


# Copied from the paper, one candidate of every generation: table, generation, rank and what it prints.
PRINTED = r"""
9 1 2 \{s_t, a_t, r_t\}
  \rightarrow \{s_{t+1}\}
9 2 2 \{s_t, a_t, a_{t+2}, r_{t+2}\}
  \rightarrow \{s_t, r_t, s_{t+1}, s_{t+2}, r_{t+2}\}
9 3 1 \{s_t, a_t, a_{t+2}, r_{t+2}\}
  \rightarrow \{s_t, s_{t+1}, s_{t+2}, r_{t+2}\}
9 4 2 \{s_t, a_t, a_{t+1}, r_{t+1}, r_{t+2}, s_{t+3}, a_{t+3}\}
  \rightarrow \{s_{t+1}, s_{t+2}, r_{t+3}, s_{t+4}\}
9 5 3 \{s_{t+1}, a_{t+1}, a_{t+2}, a_{t+3}\}
  \rightarrow \{r_t, r_{t+1}, s_{t+2}, s_{t+3}\}
9 6 2 \{s_t, a_{t+1}, a_{t+3}, s_{t+4}, r_{t+4}\}
  \rightarrow \{s_{t+1}, s_{t+2}, a_{t+3}, s_{t+4}, a_{t+4}, s_{t+5}\}
9 7 2 \{s_t, r_{t+2}, a_{t+3}, s_{t+4}\}
  \rightarrow \{a_t, s_{t+1}, s_{t+2}, r_{t+2}, a_{t+3}, r_{t+3}, s_{t+4}, a_{t+4}, r_{t+4}, s_{t+5}\}
12 1 1 \{s_t, a_t, r_t, a_{t+1}, r_{t+1}\}
  \rightarrow \{s_{t+1}, s_{t+2}\}
12 2 1 \{s_t, a_t, r_t, a_{t+1}, r_{t+1}\}
  \rightarrow \{s_{t+1}, s_{t+2}\}
12 3 1 \{s_t, a_t, r_t, a_{t+1}, r_{t+1}\}
  \rightarrow \{s_{t+1}\}
12 4 3 \{s_t, a_t, a_{t+1}, a_{t+2}, r_{t+2}, r_{t+3}, a_{t+4}, r_{t+4}, a_{t+5}, a_{t+6}, a_{t+7}, a_{t+8}, r_{t+8}\}
  \rightarrow \{a_t, s_{t+1}, s_{t+2}, a_{t+2}, s_{t+3}, s_{t+4}, s_{t+6}, a_{t+8}, s_{t+9}\}
12 5 1 \{s_t, a_t, r_t, a_{t+1}\}
  \rightarrow \{s_{t+1}, r_{t+1}\}
12 6 4 \{s_t, a_t, r_t, a_{t+1}\}
  \rightarrow \{s_{t+1}, s_{t+2}\}
12 7 1 \{s_t, a_t, r_t, a_{t+1}, r_{t+1}\}
  \rightarrow \{s_{t+1}, s_{t+2}\}
13 1 1 \{s_t, a_t\}
  \rightarrow \{r_t, s_{t+1}\}
13 2 1 \{s_t, a_t, s_{t+1}, a_{t+1}\}
  \rightarrow \{s_{t+1}, s_{t+2}\}
13 3 1 \{s_t\}
  \rightarrow \{s_t, a_t, r_t, s_{t+1}\}
13 4 2 \{s_t, a_t, s_{t+1}, a_{t+1}\}
  \rightarrow \{s_{t+2}\}
13 5 2 \{s_t, a_{t+1}, r_{t+1}, s_{t+2}, a_{t+2}, r_{t+2}\}
  \rightarrow \{s_t, r_{t+1}, s_{t+2}, a_{t+2}, s_{t+3}\}
13 6 2 \{s_t, r_t, s_{t+2}, a_{t+2}, r_{t+2}\}
  \rightarrow \{s_t, s_{t+1}, s_{t+2}, s_{t+3}\}
14 1 1 \{a_t, r_t, s_{t+1}, s_{t+2}, a_{t+2}\}
  \rightarrow \{s_t, a_{t+1}, s_{t+3}\}
14 2 1 \{a_t, r_t, a_{t+2}, r_{t+2}, s_{t+3}, a_{t+3}, r_{t+3}, a_{t+4}\}
  \rightarrow \{s_t, s_{t+1}, a_{t+1}, s_{t+2}, s_{t+4}, s_{t+5}\}
14 3 3 \{a_t, r_t, r_{t+2}, s_{t+3}, a_{t+3}, r_{t+3}, r_{t+4}\}
  \rightarrow \{s_t, s_{t+1}, a_{t+1}, s_{t+2}, a_{t+2}, a_{t+3}, s_{t+4}, s_{t+5}\}
14 4 1 \{r_t, r_{t+1}, a_{t+2}, r_{t+2}, s_{t+3}, a_{t+3}, r_{t+3}, s_{t+4}, s_{t+5}\}
  \rightarrow \{a_{t+2}, r_{t+3}, a_{t+4}\}
14 5 1 \{a_{t+1}, r_{t+1}, s_{t+2}, a_{t+2}, r_{t+2}, a_{t+3}, r_{t+3}\}
  \rightarrow \{s_t, a_t, r_t, a_{t+1}, r_{t+1}, a_{t+2}, s_{t+3}, a_{t+3}\}
"""


def test_published_losses_are_the_papers() -> None:
    for entry in PRINTED.replace("\n ", "").strip().splitlines():
        table, generation, rank, printed = entry.split(maxsplit=3)
        loss = catalog.published()[f"{TASKS[table]}-{generation}-{rank}"]
        assert as_sets(loss) == read_latex(printed)
        assert loss.latex() == printed


def test_the_two_chosen_losses_are_published_candidates() -> None:
    # Appendix D.1 calls AARL-Pixel a candidate of generation 4, but table 9 marks the one of generation 5.
    for name, printed in {"aarl-pixel": "cheetah-run-pixel-5-3", "aarl-state": "cheetah-run-state-4-4"}.items():
        assert [other for other, loss in catalog.published().items() if loss == catalog.load(name)] == [printed]
