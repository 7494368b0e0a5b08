"""In which numbers a network computes; its weights and everything else are float32 always."""

from __future__ import annotations

import torch

from gnn_policy.config import Precision


def autocast(precision: Precision, device: torch.device) -> torch.autocast:
    """The context for the network's forward passes on `device`.

    "auto" is bfloat16 where the hardware computes in it, which makes training faster, and float32 elsewhere, where it
    would make it slower.
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=resolved(precision, device) == "bfloat16")


def resolved(precision: Precision, device: torch.device) -> Precision:
    """Return the precision that "auto" means on `device`; other precisions stay the same."""
    if precision == "auto":
        return "bfloat16" if _has_bfloat16(device) else "float32"
    return precision


def _has_bfloat16(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    known = torch.cpu.get_capabilities() if device.type == "cpu" else {}
    return any(known.get(name) for name in ("avx512_bf16", "amx_bf16", "bf16"))
