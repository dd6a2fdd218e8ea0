"""Linear layers of one network or of a stack of networks, with the lineage's initialisation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, cast, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchrl_etdmpc.functional import mish

INIT_STD = 0.02

Activation = Literal["mish", "silu", "relu"]
"""What follows a normed layer."""
ACTIVATIONS: dict[Activation, Callable[[Tensor], Tensor]] = {"mish": mish, "silu": F.silu, "relu": F.relu}


class EnsembleLinear(nn.Module):
    """A linear layer, or ``E`` independent ones whose weights are stacked and applied in one batched product.

    Weights are drawn from a truncated normal with std 0.02 and biases are 0, in every member (TD-MPC2; thesis Table
    A.1 inherits it). ``zero_init=True`` starts the weights at zero as well.

    Args:
        in_features (int): input size.
        out_features (int): output size.
        num_members (int, optional): E. Default: ``None``, one layer without a member dimension.
        zero_init (bool): start at zero (last layer of the reward and value heads).

    >>> EnsembleLinear(3, 5, num_members=4)(torch.zeros(4, 7, 3)).shape
    torch.Size([4, 7, 5])
    """

    def __init__(
        self, in_features: int, out_features: int, *, num_members: int | None = None, zero_init: bool = False
    ) -> None:
        super().__init__()
        stack = () if num_members is None else (num_members,)
        self.weight = nn.Parameter(torch.empty(*stack, in_features, out_features))
        self.bias = nn.Parameter(torch.empty(*stack, out_features))
        self.zero_init = zero_init
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draws new weights, independently for every member."""
        with torch.no_grad():
            if self.zero_init:
                self.weight.zero_()
            else:
                # Departure from BMPC and TD-MPC2, whose code gave the members of an ensemble PyTorch's default
                # initialisation until July 2026: every member gets what the papers state.
                nn.init.trunc_normal_(self.weight, std=INIT_STD)
            self.bias.zero_()

    def forward(self, x: Tensor) -> Tensor:
        """Applies the layer: ``[..., in] -> [..., out]``, or ``[E, ..., in] -> [E, ..., out]`` for a stack."""
        leading = x.shape[:-1]
        if self.weight.ndim == 2:
            return torch.addmm(self.bias, x.reshape(-1, x.shape[-1]), self.weight).view(*leading, self.bias.shape[-1])
        rows = x.reshape(x.shape[0], -1, x.shape[-1])
        return torch.baddbmm(self.bias.unsqueeze(1), rows, self.weight).view(*leading, self.bias.shape[-1])

    def extra_repr(self) -> str:
        return "x".join(str(size) for size in self.weight.shape)


class NormedLinear(EnsembleLinear):
    """Linear, then dropout, LayerNorm and an activation (thesis Table 3.1; TD-MPC2, arXiv:2310.16828).

    Args:
        in_features (int): input size.
        out_features (int): output size.
        activation (callable): applied last, ``[..., out] -> [..., out]``.
        num_members (int, optional): E, as in :class:`EnsembleLinear`.
        dropout (float): probability of zeroing an output of the linear map, when ``forward`` is asked for it; in
            [0, 1).

    Raises:
        ValueError: if the probability is out of range.

    >>> NormedLinear(3, 8, activation=F.mish)(torch.zeros(2, 3)).shape
    torch.Size([2, 8])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        activation: Callable[[Tensor], Tensor],
        num_members: int | None = None,
        dropout: float = 0.0,
    ) -> None:
        if not 0 <= dropout < 1:
            raise ValueError(f"dropout must be in [0, 1), got {dropout}.")
        super().__init__(in_features, out_features, num_members=num_members)
        self.norm_weight = nn.Parameter(torch.ones_like(self.bias))
        self.norm_bias = nn.Parameter(torch.zeros_like(self.bias))
        self.activation = activation
        self.dropout = dropout

    def reset_parameters(self) -> None:
        """Draws new weights and resets the LayerNorm to the identity."""
        super().reset_parameters()
        if hasattr(self, "norm_weight"):
            with torch.no_grad():
                self.norm_weight.fill_(1.0)
                self.norm_bias.zero_()

    def forward(self, x: Tensor, *, dropout: bool = False) -> Tensor:
        """As :meth:`EnsembleLinear.forward`; ``dropout=True`` activates dropout, whatever the training mode."""
        return self.finish(super().forward(x), dropout=dropout)

    def finish(self, x: Tensor, *, dropout: bool = False) -> Tensor:
        """What follows the linear map: dropout, LayerNorm and activation, ``[..., out] -> [..., out]``."""
        if dropout and self.dropout:
            x = F.dropout(x, self.dropout, training=True)
        size = (x.shape[-1],)
        if self.weight.ndim == 2:
            x = F.layer_norm(x, size, self.norm_weight, self.norm_bias)
        else:
            affine = (-1, *(1,) * (x.ndim - 2), x.shape[-1])
            x = torch.addcmul(self.norm_bias.view(affine), F.layer_norm(x, size), self.norm_weight.view(affine))
        return self.activation(x)


class LayerStack(nn.Module):
    """Hidden :class:`NormedLinear` layers and one output layer, for one network or a stack of them.

    A subclass says in ``forward`` what goes in and what comes out; :class:`MLP` is the plain one.

    Args:
        in_features (int): input size.
        hidden_sizes (sequence of int): sizes of the hidden layers.
        out_features (int): output size.
        activation (str): ``"mish"``, ``"silu"`` or ``"relu"`` for the hidden layers.
        output_activation (callable, optional): if given, the output layer is a :class:`NormedLinear` with it; otherwise
            it is linear.
        num_members (int, optional): E, as in :class:`EnsembleLinear`.
        dropout (float): dropout of the first hidden layer.
        zero_init_output (bool): start a linear output layer at zero.

    Raises:
        ValueError: if the activation is unknown or the dropout out of range.
    """

    hidden: Sequence[NormedLinear]
    output: EnsembleLinear

    def __init__(
        self,
        in_features: int,
        hidden_sizes: Sequence[int],
        out_features: int,
        *,
        activation: Activation = "mish",
        output_activation: Callable[[Tensor], Tensor] | None = None,
        num_members: int | None = None,
        dropout: float = 0.0,
        zero_init_output: bool = False,
    ) -> None:
        super().__init__()
        if activation not in get_args(Activation):
            raise ValueError(f"activation must be one of {', '.join(get_args(Activation))}, got {activation!r}.")
        sizes = [in_features, *hidden_sizes]
        layers = nn.ModuleList(
            NormedLinear(
                size_in,
                size_out,
                activation=ACTIVATIONS[activation],
                num_members=num_members,
                dropout=dropout if i == 0 else 0.0,
            )
            for i, (size_in, size_out) in enumerate(zip(sizes[:-1], sizes[1:], strict=True))
        )
        self.hidden = cast("Sequence[NormedLinear]", layers)  # a ModuleList does not tell the type of its members
        if output_activation is None:
            self.output = EnsembleLinear(sizes[-1], out_features, num_members=num_members, zero_init=zero_init_output)
        else:
            self.output = NormedLinear(sizes[-1], out_features, activation=output_activation, num_members=num_members)

    def through(self, x: Tensor, *, dropout: bool = False) -> Tensor:
        """``[..., in] -> [..., out]``, or ``[E, ..., in] -> [E, ..., out]``; dropout only when asked for."""
        for layer in self.hidden:
            x = layer(x, dropout=dropout)
        return self.output(x)

    def reset_parameters_recursive(self) -> None:
        """Draws new weights in every layer (the hook that TorchRL's losses call)."""
        for layer in (*self.hidden, self.output):
            layer.reset_parameters()


class MLP(LayerStack):
    """Hidden :class:`NormedLinear` layers and one output layer, from one tensor to one tensor.

    Args:
        in_features (int): input size.
        hidden_sizes (sequence of int): sizes of the hidden layers.
        out_features (int): output size.

    Keyword Args:
        activation (str): ``"mish"``, ``"silu"`` or ``"relu"`` for the hidden layers. Default: ``"mish"``.
        output_activation (callable, optional): if given, the output layer is a :class:`NormedLinear` with it. Default:
            ``None``, it is linear.
        num_members (int, optional): E, of a stack of networks. Default: ``None``, one network.
        dropout (float): of the first hidden layer, in [0, 1). Default: 0.
        zero_init_output (bool): whether a linear output layer starts at zero. Default: ``False``.

    Raises:
        ValueError: if the activation is unknown or the dropout out of range.

    >>> MLP(3, [16], 2, num_members=4)(torch.zeros(4, 7, 3)).shape
    torch.Size([4, 7, 2])
    """

    def forward(self, x: Tensor, *, dropout: bool = False) -> Tensor:
        """``[..., in] -> [..., out]``, or ``[E, ..., in] -> [E, ..., out]``; dropout only when asked for."""
        return self.through(x, dropout=dropout)
