"""What the node `thread_model` publishes at every pose: prediction, estimate and margins."""

from __future__ import annotations

from magnetosuture_thread.messages.cdr import time_of
from magnetosuture_thread.messages.markers import packed_markers
from magnetosuture_thread.messages.packing import packed_estimate, packed_margins, packed_prediction
from magnetosuture_thread.model.session import PredictionResult, ThreadSession
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.lifecycle import StandbyNode


class ThreadOutputs:
    """Publishes predictions and estimates, with the margins that are proven.

    Args:
        node: that publishes.
        session: whose thread it is.
    """

    def __init__(self, node: StandbyNode[ThreadModelSettings], session: ThreadSession) -> None:
        self._session = session
        self._predicted = node.held(topics.PREDICTED_THREAD.publisher(node))
        self._estimated = node.held(topics.ESTIMATED_THREAD.publisher(node))
        self._margins = node.held(topics.MARGINS.publisher(node))
        self._markers = node.held(topics.THREAD_MARKERS.publisher(node))
        self._last_margins = 0  # stamp of those that were published [ns]

    def publish_prediction(self, result: PredictionResult, step_time: float) -> None:
        """Publish the prediction, if there is one, with the time that it took [s]."""
        if result.prediction is not None:
            when, material = time_of(result.stamp), self._session.settings.material
            self._predicted.publish(packed_prediction(when, result.prediction, material, step_time=step_time))

    def publish_estimate(self, result: PredictionResult) -> None:
        """Publish the estimate, and the margins or why there are none; no margin that is not proven."""
        if result.estimate is not None:
            self._estimated.publish(packed_estimate(time_of(result.stamp), result.estimate))
        if result.stamp >= self._last_margins or not result.late:  # those of an earlier frame are of no use any more
            self._publish_margins(result)

    def _publish_margins(self, result: PredictionResult) -> None:
        if result.late and result.estimate is None:
            return
        when, margins, of_estimate = time_of(result.stamp), result.margins, result.estimate is not None
        reason = "" if margins else result.reason
        self._margins.publish(packed_margins(when, margins, reason, result.scene_version, of_estimate=of_estimate))
        self._last_margins = result.stamp
        if self._markers.get_subscription_count() and (result.prediction or result.estimate):
            diameter = self._session.thread.diameter
            self._markers.publish(packed_markers(when, result.prediction, margins, diameter, result.estimate))
