"""sb3-aarl: Stable-Baselines3's SAC with any auxiliary loss of the AARL paper, and the search for better ones."""

from sb3_aarl.aux_loss import AuxLoss, search_space_size
from sb3_aarl.sac_aux import SACAux

__all__ = ["AuxLoss", "SACAux", "search_space_size"]
__version__ = "0.2.0"
