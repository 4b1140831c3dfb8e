"""Where to compute in bfloat16."""

import torch


def bfloat16_is_fast(device: str | torch.device) -> bool:
    """Whether a device has bfloat16 instructions: a CPU or a GPU without them emulates them, slowly."""
    match torch.device(device).type:
        case "cpu":
            return torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
        case "cuda":  # from Ampere on
            return torch.cuda.is_bf16_supported(including_emulation=False)
        case _:
            return True
