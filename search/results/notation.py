"""An auxiliary loss typeset: MathML for pages, Unicode for plain text."""

import re
from html import escape

from sb3_aarl.aux_loss import AuxLoss

_SUBSCRIPTS = str.maketrans("t+0123456789", "ₜ₊₀₁₂₃₄₅₆₇₈₉")
_TOKEN = re.compile(r"\b([sar])_t(?:\+(\d+))?")


def mathml(loss: AuxLoss) -> str:
    """
    The loss as the paper prints it, for HTML: one ``math`` element a token, because browsers break no line inside of one.

    :param loss: The loss
    """

    def token(match: re.Match[str]) -> str:
        offset = f"<mo>+</mo><mn>{match[2]}</mn>" if match[2] else ""
        return f"<math><msub><mi>{match[1]}</mi><mrow><mi>t</mi>{offset}</mrow></msub></math>"

    return _TOKEN.sub(token, escape(str(loss).replace("->", "→")))


def subscripts(loss: AuxLoss) -> str:
    """
    The loss in one line of plain text with real subscripts, such as ``{sₜ, aₜ} → {sₜ₊₁}``.

    :param loss: The loss
    """
    text = str(loss).replace("->", "→")
    return _TOKEN.sub(lambda match: match[1] + match[0][2:].translate(_SUBSCRIPTS), text)
