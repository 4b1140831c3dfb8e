"""D_theta: one transformer that denoises the motion and the symbols together (paper, Fig. "Architecture")."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Prediction(NamedTuple):
    """What the denoiser says about a corrupted plan.

    Attributes:
        motion: (B, H_c, D) the noise, the clean motion or v, as the Gaussian process was told.
        symbols: (B, H_d, m) of each of the m symbols, what their process learns: for the masked process its score
            (there is none for the mask, whose probability is zero). None where no symbols are modelled.
    """

    motion: Tensor
    symbols: Tensor | None


Denoise = Callable[[Tensor, Tensor | None, Tensor, Tensor], Prediction]
"""(motion (B, H_c, D), symbols (B, H_d, ...), k_c (B,), k_d (B,)) -> Prediction, for a fixed observation."""


class SinusoidalEmbedding(nn.Module):
    """Sines and cosines of a diffusion step: (B,) -> (B, width)."""

    def __init__(self, width: int):
        super().__init__()
        half = width // 2
        frequencies = torch.exp(-math.log(10_000) * torch.arange(half) / (half - 1))
        self.frequencies: Tensor
        self.register_buffer("frequencies", frequencies, persistent=False)

    def forward(self, step: Tensor) -> Tensor:
        angles = step[:, None] * self.frequencies
        return torch.cat([angles.sin(), angles.cos()], dim=-1)


class DecoderLayer(nn.TransformerDecoderLayer):
    """PyTorch's transformer layer, with rotary positions in self-attention (RoFormer, Su et al. 2021).

    Every token attends to every other and to all of the memory: it takes no masks.

    Args:
        positions: (L,) of the tokens, whose attention then depends on their differences; None: no rotary positions.
        args, kwargs: of `nn.TransformerDecoderLayer`, with `batch_first=True`.
    """

    def __init__(self, positions: Tensor | None, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.rotary = positions is not None
        if positions is not None:
            half = self.self_attn.head_dim // 2
            angles = positions[:, None] * 10_000 ** (-torch.arange(half) / half)
            cosines, sines = angles.cos(), angles.sin()
            self.cosines: Tensor
            self.sines: Tensor
            self.register_buffer("cosines", torch.cat([cosines, cosines], dim=-1), persistent=False)
            self.register_buffer("sines", torch.cat([-sines, sines], dim=-1), persistent=False)

    def _sa_block(
        self, x: Tensor, attn_mask: Tensor | None, key_padding_mask: Tensor | None, is_causal: bool = False
    ) -> Tensor:
        assert attn_mask is None
        assert key_padding_mask is None
        attention = self.self_attn
        heads = _heads(x, attention.in_proj_weight, attention.in_proj_bias, attention.head_dim)
        compared, [value] = heads.split([2, 1])
        query, key = self._rotate(compared) if self.rotary else compared
        return self.dropout1(_attend(attention, query, key, value))

    def _mha_block(
        self,
        x: Tensor,
        mem: Tensor,
        attn_mask: Tensor | None,
        key_padding_mask: Tensor | None,
        is_causal: bool = False,
    ) -> Tensor:
        assert attn_mask is None
        assert key_padding_mask is None
        attention, width = self.multihead_attn, x.shape[-1]
        weights, biases = (
            parameter.split([width, 2 * width]) for parameter in (attention.in_proj_weight, attention.in_proj_bias)
        )
        [query] = _heads(x, weights[0], biases[0], attention.head_dim)
        key, value = _heads(mem, weights[1], biases[1], attention.head_dim)
        return self.dropout2(_attend(attention, query, key, value))

    def _rotate(self, vectors: Tensor) -> Tensor:
        """Rotate each pair of components (i, i + half) by its token's angle: (..., L, head_dim)."""
        cosines, sines = self.cosines.to(vectors.dtype), self.sines.to(vectors.dtype)
        return vectors * cosines + vectors.roll(vectors.shape[-1] // 2, dims=-1) * sines


def _heads(x: Tensor, weight: Tensor, bias: Tensor, head_dim: int) -> Tensor:
    """Project (B, L, width) tokens to n times their width, and split them: (n, B, heads, L, head_dim)."""
    projected = F.linear(x, weight, bias).unflatten(-1, (-1, x.shape[-1] // head_dim, head_dim))
    return projected.permute(2, 0, 3, 1, 4)


def _attend(attention: nn.MultiheadAttention, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """What each query finds, (B, L, width), from (B, heads, L, head_dim) queries and (B, heads, L', head_dim) keys."""
    dropout = attention.dropout if attention.training else 0.0
    if query.device.type == "cpu" and query.dtype is torch.bfloat16 and torch.is_grad_enabled():
        # PyTorch's kernels for this case take two to three times as long, most of it in the backward pass.
        weights = F.softmax(query * query.shape[-1] ** -0.5 @ key.transpose(-1, -2), dim=-1)
        attended = F.dropout(weights, dropout) @ value
    else:
        attended = F.scaled_dot_product_attention(query, key, value, dropout_p=dropout)
    return attention.out_proj(attended.transpose(1, 2).flatten(2))


class Denoiser(nn.Module):
    """(motion prediction, symbol prediction) = D_theta(A_c, A_d, O, k_c, k_d).

    Diffusion Policy's transformer (Chi et al. 2023): the plan's tokens attend to each other, without a causal mask,
    and to the condition tokens. Motion and symbols are embedded by a linear layer each and concatenated in time, so
    that modelling symbols adds only their embedding, that of k_d, and a head.

    Args:
        action_dim: D.
        horizon: H_c.
        observation_tokens: number of condition tokens that the observation is encoded into.
        num_train_timesteps: N; k_c is embedded as a training step.
        vocabulary_size: m.
        symbolic_horizon: H_d; 0 models the motion alone (Diffuser).
        symbol_states: size of the vector that stands for a symbol.
        shared_level: k_d is always k_c, so that only the latter is a condition.
        num_layers, num_heads, width, dropout: of the transformer. Dropout acts in attention and feed-forward layers.
        rotary: tell self-attention the tokens' distances, too; symbols count as spread evenly over the motion.
    """

    def __init__(
        self,
        action_dim: int,
        horizon: int,
        observation_tokens: int,
        num_train_timesteps: int,
        vocabulary_size: int,
        symbolic_horizon: int,
        symbol_states: int,
        shared_level: bool,
        num_layers: int,
        num_heads: int,
        width: int,
        dropout: float,
        rotary: bool = False,
    ):
        super().__init__()
        self.horizon = horizon
        self.num_train_timesteps = num_train_timesteps
        self.symbol_states = symbol_states
        self.models_symbols = symbolic_horizon > 0
        self.embeds_symbol_level = self.models_symbols and not shared_level

        self.embed_motion = nn.Linear(action_dim, width)
        self.embed_motion_level = SinusoidalEmbedding(width)
        self.motion_head = nn.Linear(width, action_dim)
        if self.models_symbols:
            self.embed_symbols = nn.Linear(symbol_states, width)
            if self.embeds_symbol_level:
                self.embed_symbol_level = nn.Sequential(nn.Linear(1, width), nn.Mish(), nn.Linear(width, width))
            self.symbol_head = nn.Linear(width, vocabulary_size)
        self.positions = nn.Parameter(torch.empty(1, horizon + symbolic_horizon, width))

        condition_tokens = 1 + int(self.embeds_symbol_level) + observation_tokens
        self.condition_positions = nn.Parameter(torch.empty(1, condition_tokens, width))
        self.condition_encoder = nn.Sequential(nn.Linear(width, 4 * width), nn.Mish(), nn.Linear(4 * width, width))
        sizes = (width, num_heads, 4 * width, dropout)
        kinds: dict[str, Any] = {"activation": "gelu", "batch_first": True, "norm_first": True}
        places = torch.cat([torch.arange(horizon), torch.linspace(0, horizon - 1, symbolic_horizon)])
        layer = DecoderLayer(places if rotary else None, *sizes, **kinds)
        self.decoder = nn.TransformerDecoder(layer, num_layers, norm=nn.LayerNorm(width))
        self.apply(_initialise)
        nn.init.normal_(self.positions, std=0.02)
        nn.init.normal_(self.condition_positions, std=0.02)

    @property
    def hidden_matrices(self) -> list[nn.Parameter]:
        """The weights between hidden layers; embeddings and heads are not among them."""
        layers = (self.condition_encoder, self.decoder)
        return [parameter for layer in layers for parameter in layer.parameters() if parameter.ndim == 2]

    def forward(
        self, motion: Tensor, symbols: Tensor | None, observation: Tensor, motion_level: Tensor, symbol_level: Tensor
    ) -> Prediction:
        """Predict the clean plan behind a corrupted one.

        Args:
            motion: (B, H_c, D) noisy motion A_c.
            symbols: corrupted symbols A_d, as (B, H_d) token ids or as (B, H_d, symbol_states) noisy one-hot vectors;
                None where no symbols are modelled.
            observation: (B, n, width) encoded observation O.
            motion_level: (B,) k_c in [0, 1].
            symbol_level: (B,) k_d in [0, 1].
        """
        # A clean motion (k_c = 0) is shown at the lowest level of training, whose noise is next to none.
        step = (motion_level * self.num_train_timesteps - 1).clamp(min=0)
        plan, levels = [self.embed_motion(motion)], [self.embed_motion_level(step)]
        if symbols is not None:
            one_hot = symbols if symbols.is_floating_point() else F.one_hot(symbols, self.symbol_states)
            plan.append(self.embed_symbols(one_hot.to(self.embed_symbols.weight.dtype)))
        if self.embeds_symbol_level:
            levels.append(self.embed_symbol_level(symbol_level[:, None]))

        condition = torch.cat([torch.stack(levels, dim=1), observation], dim=1) + self.condition_positions
        memory = self.condition_encoder(condition)
        hidden = self.decoder(torch.cat(plan, dim=1) + self.positions, memory)

        with torch.autocast(hidden.device.type, enabled=False):  # bfloat16 would put waypoints on a grid
            motion_prediction = self.motion_head(hidden[:, : self.horizon].float())
        symbol_prediction = self.symbol_head(hidden[:, self.horizon :]) if self.models_symbols else None
        return Prediction(motion_prediction, symbol_prediction)


def _initialise(module: nn.Module) -> None:
    """GPT-2's initialisation, which Diffusion Policy's transformer uses."""
    if isinstance(module, nn.Linear):
        nn.init.normal_(module.weight, std=0.02)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, nn.MultiheadAttention):
        nn.init.normal_(module.in_proj_weight, std=0.02)
        nn.init.zeros_(module.in_proj_bias)
