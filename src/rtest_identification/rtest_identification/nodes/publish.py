"""Results to messages."""

from __future__ import annotations

import numpy as np
from rtest_msgs import msg

from rtest_estimation.nodes.publish import header
from rtest_identification.location import AxisMap
from rtest_identification.pipeline import Identification


def location_errors(result: Identification, stamp: int) -> msg.LocationErrors:
    """Location and squareness errors; what the data do not determine is left out."""
    location = result.location
    known = np.flatnonzero(location.determined)
    return msg.LocationErrors(
        header=header(stamp, 'machine'),
        session=result.session,
        symbols=[location.symbols[i] for i in known],
        values=location.value[known].tolist(),
        covariance=location.covariance[np.ix_(known, known)].ravel().tolist(),
        residual=result.fit.rms,
    )


def error_map(result: Identification, axis_map: AxisMap, stamp: int) -> msg.ErrorMap:
    """One axis's position-dependent errors over the stations of the outer rotary axis."""
    return msg.ErrorMap(
        header=header(stamp, 'machine'),
        session=result.session,
        axis=axis_map.axis,
        symbols=[p.symbol for p in axis_map.parameters],
        b=axis_map.stations.tolist(),
        c=[],
        values=axis_map.value.ravel().tolist(),
        stddev=axis_map.stddev.ravel().tolist(),
        residual=result.fit.rms,
    )
