"""Forces of stiff springs on compliant points: many small dense systems at once.

    x = D (1 + C D)^-1 a = D (a - R (1 + R' D R)^-1 R' D a),    C = R R'

(Woodbury 1950): what springs of stiffness D, which may be a thousand times that of what they rest on, add where they
are pressed by a, unrelieved. Its potential is convex where 1 + R' D R is positive definite.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from ..runtime.device import Device
from ..runtime.views import on_host


def relieved(device: Device, compliance: Any, stiffness: Any, along: Any) -> tuple[Any, np.ndarray]:
    """x (k, n, 1) of C and D (k, n, n) and a (k, n, 1), arrays of `views.library`; which of them (k,) are convex.

    Of the others x means nothing.
    """
    if device.on_cuda:
        import torch

        root, rounded = torch.linalg.cholesky_ex(compliance)
        eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device)
        factor, failed = torch.linalg.cholesky_ex(eye + root.mT @ stiffness @ root)
        inner = torch.cholesky_solve(root.mT @ (stiffness @ along), factor)
        return stiffness @ (along - root @ inner), on_host((failed == 0) & (rounded == 0))
    out, convex = np.zeros_like(along), np.ones(len(along), bool)
    for row, (C, D, a) in enumerate(zip(compliance, stiffness, along, strict=True)):
        try:
            root = np.linalg.cholesky(C)
            factor = cho_factor(np.eye(len(root)) + root.T @ (D @ root), overwrite_a=True, check_finite=False)
        except LinAlgError:
            convex[row] = False
            continue
        out[row] = D @ (a - root @ cho_solve(factor, root.T @ (D @ a), check_finite=False))
    return out, convex
