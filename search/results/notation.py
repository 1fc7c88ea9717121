"""An auxiliary loss typeset: MathML for pages, Unicode for plain text."""

from html import escape

from sb3_aarl.aux_loss import AuxLoss, Token

_SUBSCRIPTS = str.maketrans("t+0123456789", "ₜ₊₀₁₂₃₄₅₆₇₈₉")


def mathml(loss: AuxLoss) -> str:
    """
    The loss as the paper prints it, for HTML: one ``math`` element a token, because browsers break no line inside of one.

    :param loss: The loss
    """
    sets = (_set_mathml(loss.source_tokens), _set_mathml(loss.target_tokens))
    options = f" {escape(_options(loss))}" if _options(loss) else ""
    return " <math><mo>→</mo></math> ".join(sets) + options


def subscripts(loss: AuxLoss) -> str:
    """
    The loss in one line of plain text with real subscripts, such as ``{sₜ, aₜ} → {sₜ₊₁}``.

    :param loss: The loss
    """
    sets = (
        "{" + ", ".join(f"{token.kind}{str(token)[2:].translate(_SUBSCRIPTS)}" for token in tokens) + "}"
        for tokens in (loss.source_tokens, loss.target_tokens)
    )
    return " ".join([" → ".join(sets), _options(loss)]).rstrip()


def _options(loss: AuxLoss) -> str:
    """What the plain notation says in brackets, if anything."""
    return str(loss).partition("} -> ")[2].partition("} ")[2]


def _set_mathml(tokens: tuple[Token, ...]) -> str:
    elements = []
    for position, token in enumerate(tokens):
        offset = f"<mo>+</mo><mn>{token.offset}</mn>" if token.offset else ""
        opening = "<mo>{</mo>" if position == 0 else ""
        closing = "<mo>}</mo>" if position == len(tokens) - 1 else "<mo>,</mo>"
        subscript = f"<msub><mi>{token.kind}</mi><mrow><mi>t</mi>{offset}</mrow></msub>"
        elements.append(f"<math><mrow>{opening}{subscript}{closing}</mrow></math>")
    return " ".join(elements)
