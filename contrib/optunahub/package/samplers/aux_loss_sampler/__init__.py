from sb3_aarl.search.evolution.sampler import AuxLossSampler
from sb3_aarl.search.evolution.space import suggest_aux_loss

__all__ = ["AuxLossSampler", "suggest_aux_loss"]
