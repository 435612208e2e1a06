"""When a needle that is commanded rests."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.planning.rest import REST_TIME, RestDetector


def test_a_needle_that_rests_is_noticed_within_as_long_once_time_was_set_back():
    detector, noticed = RestDetector(), []
    for stamp in (*np.arange(100.0, 100.0 + 0.8 * REST_TIME, 0.05), *np.arange(0.0, 1.2 * REST_TIME, 0.05)):
        noticed.append(detector.update(float(stamp), np.zeros(2), 0.0, 1e-3, True, 0.0))
    assert not any(noticed[:20])
    assert noticed[-1]
