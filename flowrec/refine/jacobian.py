"""The derivative of the discrete equations as a sparse matrix, read off the convolutions themselves."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor

from flowrec.refine.residuals import Physics

REACH = 3  # pixels this far apart have no equation in common


def jacobian(physics: Physics, image: Tensor) -> sp.csr_array:
    """(3 h w, 3 h w) derivative of `Physics.residuals` around an image (1, 3, h, w) of vx, vy, p.

    The equations are quadratic, so central differences of any size are exact; every third pixel of every third row
    is probed at once.
    """
    h, w = image.shape[-2:]
    row, column = np.mgrid[:h, :w]
    color = (row % REACH) * REACH + column % REACH
    probes = torch.zeros(3, REACH**2, 3, h, w, dtype=image.dtype)
    for channel in range(3):
        for number in range(REACH**2):
            probes[channel, number, channel] = torch.from_numpy(color == number).to(image.dtype)
    probes = probes.flatten(0, 1)
    more, less = image + probes, image - probes
    change = physics.residuals(more[:, :2], more[:, 2:]) - physics.residuals(less[:, :2], less[:, 2:])
    slopes = 0.5 * change.numpy().reshape(3, REACH**2, 3, h, w)
    index = np.arange(h * w).reshape(h, w)
    rows, columns, values = [], [], []
    for dy, dx in ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0)):
        there = (slice(max(dy, 0), h + min(dy, 0)), slice(max(dx, 0), w + min(dx, 0)))
        here = (slice(max(-dy, 0), h + min(-dy, 0)), slice(max(-dx, 0), w + min(-dx, 0)))
        for channel in range(3):
            found = slopes[channel, color[there], :, row[here], column[here]]  # (h', w', 3 equations)
            for equation in range(3):
                value = found[..., equation]
                kept = value != 0.0
                rows.append(equation * h * w + index[here][kept])
                columns.append(channel * h * w + index[there][kept])
                values.append(value[kept])
    shape = (3 * h * w, 3 * h * w)
    return sp.csr_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape)
