"""Where to compute in bfloat16."""

import torch


def bfloat16_is_fast(device: str | torch.device) -> bool:
    """Whether a device has bfloat16 instructions: a CPU without them takes several times as long for a product."""
    if torch.device(device).type != "cpu":
        return True
    return torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
