"""Several small networks of equal shape, evaluated together by batched matrix products."""

import math
from collections.abc import Sequence

import torch as th
from torch import nn


class ParallelLinear(nn.Module):
    """
    ``n_nets`` independent linear layers, applied at once: input (n_nets, batch, in), output (n_nets, batch, out).

    Each net is initialised as ``torch.nn.Linear`` initialises one.

    :param n_nets: number of layers side by side
    :param in_features: size of each input
    :param out_features: size of each output
    """

    def __init__(self, n_nets: int, in_features: int, out_features: int):
        super().__init__()
        bound = 1 / math.sqrt(in_features)
        # Registered before they are filled, so that `load_policy` can refuse sizes while they take no memory yet
        self.weight = nn.Parameter(th.empty(n_nets, in_features, out_features))
        self.bias = nn.Parameter(th.empty(n_nets, 1, out_features))
        for parameter in (self.weight, self.bias):
            nn.init.uniform_(parameter, -bound, bound)

    def forward(self, x: th.Tensor) -> th.Tensor:
        return th.baddbmm(self.bias, x, self.weight)


class ParallelMLP(nn.Sequential):
    """
    ``n_nets`` independent multi-layer perceptrons: input (n_nets, batch, in), output (n_nets, batch, out).

    :param n_nets: number of networks side by side
    :param in_features: size of each input
    :param out_features: size of each output
    :param net_arch: widths of the hidden layers
    :param activation_fn: activation between the layers
    """

    def __init__(
        self,
        n_nets: int,
        in_features: int,
        out_features: int,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module] = nn.ReLU,
    ):
        layers: list[nn.Module] = []
        for width in net_arch:
            layers += [ParallelLinear(n_nets, in_features, width), activation_fn()]
            in_features = width
        super().__init__(*layers, ParallelLinear(n_nets, in_features, out_features))
