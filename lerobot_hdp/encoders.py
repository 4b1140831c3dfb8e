"""Observation -> condition tokens."""

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from lerobot.configs import PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionRgbEncoder
from torch import Tensor, nn
from torchvision.models import get_model


class StateEncoder(nn.Module):
    """Condition tokens from observations that are vectors: low-dimensional ones, and the features of images.

    The observations are concatenated and cut into parts; each part becomes a token. One part is Diffusion Policy's
    way. With a part for each object, attention can look up the one that a symbol names, instead of finding its
    numbers in a vector of all.

    Args:
        keys: names of the observations, in the order in which they are concatenated.
        token_sizes: size of each part.
        width: size of a token.
        weight_std: standard deviation of the initial weights that an observation meets first.
        hidden_dim: 0 makes a token by a linear layer, more by an MLP with as many hidden units. Their initial weights
            and thresholds are spread over `weight_std`, so that they respond to observations that differ by about
            1 / `weight_std`: fine positions are learned early (Tancik et al. 2020, "Fourier features let networks
            learn high frequency functions in low dimensional domains").
    """

    def __init__(
        self, keys: Iterable[str], token_sizes: Iterable[int], width: int, weight_std: float, hidden_dim: int = 0
    ):
        super().__init__()
        self.keys = list(keys)
        self.token_sizes = list(token_sizes)
        self.projections = nn.ModuleList()
        for size in self.token_sizes:
            first = nn.Linear(size, hidden_dim or width)
            nn.init.normal_(first.weight, std=weight_std)
            if hidden_dim:
                nn.init.uniform_(first.bias, -weight_std, weight_std)
                self.projections.append(nn.Sequential(first, nn.GELU(), nn.Linear(hidden_dim, width)))
            else:
                nn.init.zeros_(first.bias)
                self.projections.append(first)

    @property
    def num_tokens(self) -> int:
        return len(self.token_sizes)

    def forward(self, batch: Mapping[str, Tensor]) -> Tensor:
        """Observations (B, n) or (B, 1, n), or (B,) where n is 1, each -> (B, num_tokens, width)."""
        state = torch.cat([batch[key].reshape(len(batch[key]), -1) for key in self.keys], dim=-1)
        parts = state.float().split(self.token_sizes, dim=-1)
        with torch.autocast(state.device.type, enabled=False):  # bfloat16 would round positions
            return torch.stack([project(part) for project, part in zip(self.projections, parts, strict=True)], dim=1)


class ImageEncoder(nn.Module):
    """Features of the observed images, by LeRobot's encoder of Diffusion Policy, one for each camera.

    A ResNet whose last feature maps are read as keypoints: of each, where in the image it is most active (spatial
    softmax; Finn et al. 2016, "Deep Spatial Autoencoders for Visuomotor Learning").

    Args:
        cameras: names of the observed images, and their shapes (3, height, width).
        group_norm: True for ResNets that are trained from scratch; False for pretrained ones, whose batch statistics
            stay as they are, since an average of weights has none of its own.
        options: more of `DiffusionConfig`.
    """

    def __init__(self, cameras: Mapping[str, PolicyFeature], group_norm: bool, **options: Any):
        super().__init__()
        self.cameras = list(cameras)
        options |= {"use_group_norm": group_norm, "pretrained_backbone_weights": None, "device": "cpu"}
        self.encoders = nn.ModuleList(
            DiffusionRgbEncoder(DiffusionConfig(input_features={name: camera}, **options))
            for name, camera in cameras.items()
        )

    def load_backbones(self, vision_backbone: str, weights: str) -> None:
        """Start from torchvision's weights, which are downloaded if they were not before."""
        layers = list(get_model(vision_backbone, weights=weights).children())
        for encoder in self.encoders:
            encoder.backbone.load_state_dict(nn.Sequential(*layers[:-2]).state_dict())

    def train(self, mode: bool = True) -> "ImageEncoder":
        """Batch statistics stay as they are."""
        super().train(mode)
        for module in self.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()
        return self

    def forward(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Normalised images (B, 3, height, width) of each camera -> features (B, 2 * keypoints) of each."""
        return {camera: encode(batch[camera]) for camera, encode in zip(self.cameras, self.encoders, strict=True)}
