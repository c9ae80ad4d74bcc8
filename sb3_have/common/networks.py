"""Several small networks of the same shape, evaluated together by batched matrix products."""

import math
from collections.abc import Sequence

import torch as th
from torch import nn


class ParallelLinear(nn.Module):
    """
    ``n_nets`` independent linear layers, applied at once: input (n_nets, batch, in), output (n_nets, batch, out).

    Each layer is initialised as in ``torch.nn.Linear``.

    :param n_nets: Number of layers
    :param in_features: Size of each input
    :param out_features: Size of each output
    """

    def __init__(self, n_nets: int, in_features: int, out_features: int):
        super().__init__()
        bound = 1 / math.sqrt(in_features)
        # Register parameters before filling them, so that `load_policy` can check their sizes before memory is used
        self.weight = nn.Parameter(th.empty(n_nets, in_features, out_features))
        self.bias = nn.Parameter(th.empty(n_nets, 1, out_features))
        for parameter in (self.weight, self.bias):
            nn.init.uniform_(parameter, -bound, bound)

    def forward(self, x: th.Tensor) -> th.Tensor:
        return th.baddbmm(self.bias, x, self.weight)


class ParallelMLP(nn.Sequential):
    """
    ``n_nets`` independent multi-layer perceptrons: input (n_nets, batch, in), output (n_nets, batch, out).

    :param n_nets: Number of networks
    :param in_features: Size of each input
    :param out_features: Size of each output
    :param net_arch: Widths of the hidden layers
    :param activation_fn: Activation function
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
