"""Numbers that are not finite are errors, wherever they appear first."""

from __future__ import annotations

from collections.abc import Mapping

import torch


def require_finite(tensors: Mapping[str, torch.Tensor], what: str = "the policy's weights") -> None:
    """Check tensors of any types.

    Raises:
        ValueError: If one holds NaN or an infinity; it says `what` is damaged and names the tensor.
    """
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{what} are not finite numbers ({name}): train again with a smaller lr")
