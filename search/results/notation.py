"""An auxiliary loss typeset: MathML for pages."""

import re
from html import escape

from sb3_aarl.aux_loss import AuxLoss

_TOKEN = re.compile(r"\b([sar])_t(?:\+(\d+))?")


def mathml(loss: AuxLoss) -> str:
    """The loss as the paper prints it, for HTML: one ``math`` element a token, as browsers break no line inside of one."""

    def token(match: re.Match[str]) -> str:
        offset = f"<mo>+</mo><mn>{match[2]}</mn>" if match[2] else ""
        return f"<math><msub><mi>{match[1]}</mi><mrow><mi>t</mi>{offset}</mrow></msub></math>"

    return _TOKEN.sub(token, escape(str(loss).replace("->", "→")))
