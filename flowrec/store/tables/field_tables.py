"""Flow fields and observations as tables with a row a place: what a person plots, and what `flowrec.refine` reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from flowrec.core import VALUES, FlowField, Observations, unit_of, values_of
from flowrec.store.tables.observed import OBSERVED


def observed_flow(observations: Observations) -> pa.Table:
    """Observations with a row each, in the columns OBSERVED; what is not stated is empty."""
    n = len(observations.position_um)
    none = np.full((n, 2), np.nan)
    rolled = observations.rolled_um_s if observations.rolled_um_s is not None else none
    time_s = observations.time_s if observations.time_s is not None else none[:, 0]
    parts = (observations.position_um, observations.flow_um_s, observations.std_um_s[:, None], rolled, time_s[:, None])
    empty = {
        "own_u_um_s": observations.rolled_um_s is None,
        "own_v_um_s": observations.rolled_um_s is None,
        "time_s": observations.time_s is None,
    }
    return _table(OBSERVED, np.hstack(parts), empty)


def field_values(field: FlowField, fluid: NDArray[np.bool_]) -> pa.Table:
    """A flow field with a row for each pixel of fluid.

    Parameters
    ----------
    fluid : (h, w), where the chip holds fluid.
    """
    return _table(VALUES, values_of(field, fluid), dict.fromkeys(("std_u_um_s", "std_v_um_s"), field.std_um_s is None))


def _table(columns: Mapping[str, str], values: NDArray[Any], empty: Mapping[str, bool]) -> pa.Table:
    schema = pa.schema(
        [
            pa.field(name, pa.float64(), metadata={"unit": unit_of(name), "meaning": text})
            for name, text in columns.items()
        ]
    )
    arrays = [
        pa.nulls(len(values), pa.float64()) if empty.get(name) else pa.array(np.ascontiguousarray(values[:, number]))
        for number, name in enumerate(columns)
    ]
    return pa.Table.from_arrays(arrays, schema=schema)
