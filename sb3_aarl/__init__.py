"""sb3-aarl: Stable-Baselines3's SAC with any auxiliary loss of the AARL paper, and the search for better ones."""

from typing import TYPE_CHECKING, Any

from sb3_aarl.aux_loss import AuxLoss

if TYPE_CHECKING:
    from sb3_aarl.sac_aux import SACAux

__all__ = ["AuxLoss", "SACAux"]
__version__ = "0.2.0"


def __getattr__(name: str) -> Any:
    """SACAux when it is needed: PyTorch takes seconds to import, and the help of ``aarl`` does without it."""
    if name == "SACAux":
        from sb3_aarl.sac_aux import SACAux

        return SACAux
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
