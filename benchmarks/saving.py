"""Where benchmarks write what they measure."""

import json
from pathlib import Path
from typing import Any

from sb3_aarl.search.training.provenance import provenance


def save_result(path: Path, **result: Any) -> None:
    """Write what was measured, plain values, to a file as JSON, with :func:`provenance` beside it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**provenance(), **result}, indent=1) + "\n")
