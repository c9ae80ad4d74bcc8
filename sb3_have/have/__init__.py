"""
Hierarchical Adaptive Value Estimation: the algorithm, its policy, critic, auxiliary losses and callbacks; networks and
memory that other algorithms can use too are in :mod:`sb3_have.common`.
"""

from sb3_have.have.auxiliary import AuxiliaryLoss, AuxiliaryLossCallback, DeepMDP, DeepMDPCallback
from sb3_have.have.callbacks import ModalityWeightsCallback
from sb3_have.have.critic import AssignmentNetwork, GlobalCritic, LocalCritics, MultiModalCritic, RefusionNetwork
from sb3_have.have.have import HAVESAC
from sb3_have.have.policies import MultiInputPolicy, MultiModalPolicy

__all__ = [
    "HAVESAC",
    "AssignmentNetwork",
    "AuxiliaryLoss",
    "AuxiliaryLossCallback",
    "DeepMDP",
    "DeepMDPCallback",
    "GlobalCritic",
    "LocalCritics",
    "ModalityWeightsCallback",
    "MultiInputPolicy",
    "MultiModalCritic",
    "MultiModalPolicy",
    "RefusionNetwork",
]
