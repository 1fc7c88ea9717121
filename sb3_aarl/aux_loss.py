"""AuxLoss: what an auxiliary loss predicts from what, as one immutable value, and its notation."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Integral
from typing import Any, NamedTuple

import yaml

OPERATORS = ("inner", "bilinear", "cosine", "mse", "n_mse")
KINDS = "sar"  # state, action, reward: the token of kind KINDS[j] at offset i has index 3 * i + j
# Guards against a mistyped number that would ask for a mask of millions of bits.
LONGEST_HORIZON = 1000

# Of a notation without spaces, ``$``, backslashes, and braces around indices.
_TOKEN = re.compile(r"([sar])_t(?:\+([0-9]+))?")
_NOTATION = re.compile(r"\{([^{}]*)\}->\{([^{}]*)\}(?:\[([^\[\]]*)\])?")


class Token(NamedTuple):
    """One element of the sequence (s_t, a_t, r_t, s_{t+1}, ..., s_{t+k}); ``kind`` is ``s``, ``a`` or ``r``."""

    kind: str
    offset: int

    @classmethod
    def of(cls, index: int) -> "Token":
        """The token at ``index`` of a mask."""
        return cls(KINDS[index % 3], index // 3)

    @property
    def horizon(self) -> int:
        """The smallest horizon that has this token: actions and rewards lie between two states."""
        return max(1, self.offset if self.kind == "s" else self.offset + 1)

    def __str__(self) -> str:
        return f"{self.kind}_t+{self.offset}" if self.offset else f"{self.kind}_t"

    def latex(self) -> str:
        """The token as the paper prints it, such as ``s_{t+1}``."""
        return f"{self.kind}_{{t+{self.offset}}}" if self.offset else f"{self.kind}_t"


@dataclass(frozen=True)
class AuxLoss:
    """
    An auxiliary loss of the paper's search space (section 2.1): a source mask, a target mask and an operator.

    The masks select tokens of the sequence (s_t, a_t, r_t, s_{t+1}, ..., s_{t+k}), k being the horizon: the state at
    offset i has index 3i, the action 3i + 1, the reward 3i + 2. The value is frozen, hashable and picklable;
    ``yaml.safe_dump`` writes it as its notation.

    :param horizon: Number of agent steps k that the sequence spans, from 1 to 1000
    :param source: 3k + 1 booleans, what the prediction is made from (at least one state, paper A.3)
    :param target: 3k + 1 booleans, what is predicted (not empty, paper A.3)
    :param operator: How far a prediction is from its target, one of ``OPERATORS`` (paper A.1.3)
    :param negatives: Whether the operator contrasts with other rows of the batch
    :raises ValueError: when the loss is not valid; the message names the rule or the token
    """

    horizon: int
    source: tuple[bool, ...]
    target: tuple[bool, ...]
    operator: str = "mse"
    negatives: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "horizon", _checked_horizon(self.horizon))
        for name in ("source", "target"):
            mask = tuple(getattr(self, name))
            if len(mask) != 3 * self.horizon + 1:
                raise ValueError(f"{name} has {len(mask)} bits, but horizon {self.horizon} has {3 * self.horizon + 1} tokens")
            if any(bit not in (False, True) for bit in mask):
                raise ValueError(f"{name} must be booleans, not {mask!r}")
            object.__setattr__(self, name, tuple(map(bool, mask)))
        if self.operator not in OPERATORS:
            raise ValueError(f"unknown operator {self.operator!r}, expected one of {', '.join(OPERATORS)}")
        if self.negatives not in (False, True):  # bool() would take the text "false" for true
            raise ValueError(f"negatives must be a boolean, not {self.negatives!r}")
        object.__setattr__(self, "negatives", bool(self.negatives))
        if not any(self.source[::3]):
            named = ", ".join(map(str, self.source_tokens)) or "nothing"
            raise ValueError(f"the source needs at least one state, or no gradient reaches the encoder; it has {named}")
        if not any(self.target):
            raise ValueError("the target is empty: there is nothing to predict")

    @classmethod
    def from_tokens(
        cls,
        source: Iterable[Token],
        target: Iterable[Token],
        operator: str = "mse",
        negatives: bool = False,
        horizon: int | None = None,
    ) -> "AuxLoss":
        """The loss that predicts the tokens ``target`` from the tokens ``source``, with the smallest horizon if it is None."""
        source, target = set(source), set(target)
        longest = max(source | target, key=lambda token: token.horizon, default=Token("s", 0))
        horizon = _checked_horizon(longest.horizon if horizon is None else horizon)
        if horizon < longest.horizon:
            raise ValueError(f"{longest} needs a horizon of at least {longest.horizon}, not {horizon}")
        masks = [tuple(Token.of(i) in tokens for i in range(3 * horizon + 1)) for tokens in (source, target)]
        return cls(horizon, masks[0], masks[1], operator, negatives)

    @classmethod
    def parse(cls, text: str, operator: str = "mse", negatives: bool = False, horizon: int | None = None) -> "AuxLoss":
        r"""
        Read the paper's notation, plain (``{s_t, a_t} -> {s_t+1}``) or LaTeX (``\{s_t, a_t\} \rightarrow \{s_{t+1}\}``).

        What differs from the defaults may follow in brackets, as ``str(loss)`` writes it:
        ``{s_t} -> {s_t} [bilinear, negatives, horizon=2]``.

        :param text: The notation; brackets in it win over the other arguments' defaults
        :param horizon: None for the smallest that holds all tokens
        :raises ValueError: naming what cannot be read, or the rule that the loss breaks
        """
        plain = re.sub(r"[\s$\\]", "", re.sub(r"\\(rightarrow|to)(?![a-zA-Z])|→", "->", str(text)))
        match = _NOTATION.fullmatch(re.sub(r"_\{(t(?:\+[0-9]+)?)\}", r"_\1", plain))
        if match is None:
            raise ValueError(f"a notation is a text such as '{{s_t, a_t}} -> {{s_t+1}}', not {text!r}")
        options = {"operator": operator, "negatives": negatives, "horizon": horizon}
        unset = {"operator": "mse", "negatives": False, "horizon": None}
        for key, value in _options(match[3], text).items() if match[3] is not None else ():
            if options[key] not in (unset[key], value):
                raise ValueError(f"{key} is {options[key]!r}, but the notation says {value!r}: {text!r}")
            options[key] = value
        return cls.from_tokens(_tokens(match[1], text), _tokens(match[2], text), **options)  # type: ignore[arg-type]

    @property
    def source_tokens(self) -> tuple[Token, ...]:
        """The tokens of the source, in the order of the sequence."""
        return tuple(Token.of(i) for i, chosen in enumerate(self.source) if chosen)

    @property
    def target_tokens(self) -> tuple[Token, ...]:
        """The tokens of the target, in the order of the sequence."""
        return tuple(Token.of(i) for i, chosen in enumerate(self.target) if chosen)

    def __str__(self) -> str:
        sets = " -> ".join("{" + ", ".join(map(str, tokens)) + "}" for tokens in (self.source_tokens, self.target_tokens))
        options = [self.operator] if self.operator != "mse" else []
        options += ["negatives"] if self.negatives else []
        smallest = max(token.horizon for token in self.source_tokens + self.target_tokens)
        options += [f"horizon={self.horizon}"] if self.horizon != smallest else []
        return f"{sets} [{', '.join(options)}]" if options else sets

    def latex(self) -> str:
        r"""The masks as the paper prints them, such as ``\{s_t, a_t\} \rightarrow \{s_{t+1}\}``, for math mode."""
        sets = (", ".join(token.latex() for token in tokens) for tokens in (self.source_tokens, self.target_tokens))
        return r" \rightarrow ".join(rf"\{{{tokens}\}}" for tokens in sets)

    def canonical(self) -> "AuxLoss":
        """
        The same loss, shifted to start at t, with the smallest horizon.

        Windows are drawn uniformly, so two losses with one canonical form are one loss, in episodes as long as both horizons.
        """
        chosen = [in_source or in_target for in_source, in_target in zip(self.source, self.target, strict=True)]
        first = chosen.index(True) // 3 * 3
        last = len(chosen) - 1 - chosen[::-1].index(True)
        horizon = max(1, -(-(last - first) // 3))  # state i closes step i, action and reward i lie in step i + 1
        if first == 0 and horizon == self.horizon:
            return self
        # A state at the very end, alone, has no step behind it.
        source, target = ((mask[first:] + (False,) * 3)[: 3 * horizon + 1] for mask in (self.source, self.target))
        return AuxLoss(horizon, source, target, self.operator, self.negatives)


# Configurations are plain YAML: a loss is written as its notation, never as a Python object.
for _dumper in (yaml.SafeDumper, yaml.Dumper):
    _dumper.add_representer(AuxLoss, lambda dumper, loss: dumper.represent_str(str(loss)))


def _checked_horizon(horizon: Any) -> int:
    if isinstance(horizon, bool) or not isinstance(horizon, Integral) or not 1 <= int(horizon) <= LONGEST_HORIZON:
        raise ValueError(f"horizon must be an integer from 1 to {LONGEST_HORIZON}, not {horizon!r}")
    return int(horizon)


def _tokens(words: str, text: str) -> list[Token]:
    """The tokens between two braces."""
    tokens: list[Token] = []
    for word in words.split(",") if words else []:
        match = _TOKEN.fullmatch(word)
        if match is None:
            raise ValueError(f"{word!r} is not a token such as s_t, a_t+1 or r_t+2: {text!r}")
        token = Token(match[1], int(match[2] or 0))
        if token in tokens:
            raise ValueError(f"{token} appears twice: {text!r}")
        tokens.append(token)
    return tokens


def _options(words: str, text: str) -> dict[str, Any]:
    """What stands between brackets."""
    options: dict[str, Any] = {}
    for word in words.split(","):
        horizon = re.fullmatch(r"horizon=([0-9]{1,4})", word)
        key = "operator" if word in OPERATORS else "horizon" if horizon else word
        if key not in ("operator", "negatives", "horizon") or key in options:
            raise ValueError(f"{word!r} is none of {', '.join(OPERATORS)}, negatives, horizon=k, each at most once: {text!r}")
        options[key] = int(horizon[1]) if horizon else word if key == "operator" else True
    return options
