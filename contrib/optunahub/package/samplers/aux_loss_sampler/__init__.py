from search.evolution.sampler import AuxLossSampler
from search.evolution.space import suggest_aux_loss

__all__ = ["AuxLossSampler", "suggest_aux_loss"]
