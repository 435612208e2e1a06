"""Forecasts in a graph: with each estimate, under the command that the bridge follows, and none unless asked for."""

from __future__ import annotations

import math
import re
from threading import Event, current_thread
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point, Vector3
from magnetosuture_msgs.msg import FilterState
from magnetosuture_msgs.srv import ForecastPath

from magnetosuture_thread import Disc, ForecastStart, NeedlePose, NeedleSafetyFilter, Scene, Thread, ThreadForecaster
from magnetosuture_thread.bags.packing import forecast_text, packed_forecast
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.thread_model import make_path_follower
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.settings.interface import Service
from magnetosuture_thread.thread.material import MATERIALS, Attachment
from test.estimator.threads import whole
from test.nodes import wire
from test.nodes.test_thread_estimate import NODES, WAY, counting, stamp
from test.shared import known

HORIZON = 0.6


def filter_state(k: int, x: float, y: float) -> FilterState:
    return FilterState(header=wire.header(stamp(k)), commanded=Vector3(x=x, y=y), filtered=Vector3(x=x, y=y))


def test_every_estimate_has_a_forecast_under_the_present_command(graph: Any, monkeypatch: pytest.MonkeyPatch):
    bench = counting(monkeypatch, graph, scene="dish_150mm", forecast_horizon=HORIZON, forecast_step=0.03)
    forecasts, markers = graph.listen(topics.FORECAST), graph.listen(topics.THREAD_MARKERS)
    bench.show(0)
    graph.wait(lambda: len(forecasts) == 1, "a forecast")
    (first,) = forecasts
    assert first.header.stamp == stamp(0)
    assert (first.commanded.x, first.commanded.y) == (0.0, 0.0)  # nobody commands the needle
    assert (first.tail[-1].x, first.tail[-1].y) == (first.tail[0].x, first.tail[0].y)
    heading = WAY[1].heading
    x, y = (0.004 * heading).tolist()
    graph.publish(topics.FILTER_STATE, filter_state(1, x, y))
    graph.wait(lambda: forecast_after(bench, forecasts).commanded.x == x, "a forecast under the command")
    message = forecasts[-1]
    assert message.horizon == pytest.approx(HORIZON)
    assert message.converged
    assert len(message.positions) == 26 * len(message.time)
    moved = math.hypot(message.tail[-1].x - message.tail[0].x, message.tail[-1].y - message.tail[0].y)
    assert moved == pytest.approx(0.004 * HORIZON, rel=0.05)
    graph.wait(lambda: any(marker.ns == "forecast" for each in markers for marker in each.markers), "markers")


def test_a_forecast_that_is_made_for_other_settings_is_dropped(graph: Any, monkeypatch: pytest.MonkeyPatch):
    begun, go, forecast = Event(), Event(), ThreadForecaster.forecast

    def delayed(*arguments: Any, **options: Any) -> Any:
        if current_thread().name.startswith("forecasts"):
            begun.set()
            go.wait(30.0)
        return forecast(*arguments, **options)

    bench = counting(monkeypatch, graph, scene="dish_150mm", forecast_horizon=HORIZON, forecast_step=0.03)
    forecasts = graph.listen(topics.FORECAST)
    monkeypatch.setattr(ThreadForecaster, "forecast", delayed)
    bench.show(0)
    assert begun.wait(30.0)
    bench.node.change({"segments": 30})
    bench.show(1)
    go.set()
    graph.wait(lambda: bool(forecasts), "a forecast")
    assert forecast_after(bench, forecasts, 2).header.stamp == stamp(2)
    assert [len(each.positions) / len(each.time) for each in forecasts] == [31, 31]


def forecast_after(bench: Any, forecasts: list[Any], frame: int | None = None) -> Any:
    """Show a frame, the next one by default, and return the forecast from it."""
    before = len(forecasts)
    k = before if frame is None else frame
    bench.show(k, whole(NODES[k], k))
    bench.graph.wait(lambda: len(forecasts) > before, "a forecast")
    return forecasts[-1]


def test_the_message_says_what_happens_when():
    where = Scene.create(shapes={"post": Disc((-0.004, 0.002), 0.001)})
    thread = Thread.of(MATERIALS["polyamide_7_0"], length=0.012, segments=40, attachment=Attachment.PINNED)
    forecaster = ThreadForecaster(thread, where, NeedleSafetyFilter(where))
    start = forecaster.straight(NeedlePose(0.0, np.zeros(2), np.array([1.0, 0.0])))
    forecast = forecaster.forecast(ForecastStart(start.pose, start.vertices), np.array([0.0, 0.003]), 2.0)
    message = topics.FORECAST.decode(packed_forecast(stamp(0), forecast))
    contact = known(forecast.first_contact)
    assert (message.contact_time, message.contact_shape, message.contact_node) == (contact.time, "post", contact.node)
    assert message.clearance[0] == forecast.minima["obstacle"].value
    assert message.clearance_shape[0] == "post"
    assert forecast_text(forecast).startswith(f"touches the post in {contact.time:.1f} s")
    still = forecaster.forecast(start, np.zeros(2), 0.1)
    assert not forecast_text(still)
    assert math.isnan(topics.FORECAST.decode(packed_forecast(stamp(0), still)).contact_time)


def test_a_client_is_told_what_happens_along_its_path(graph: Any, monkeypatch: pytest.MonkeyPatch):
    bench = counting(monkeypatch, graph, scene="dish_150mm", forecast_horizon=HORIZON, forecast_step=0.03)
    forecasts = graph.listen(topics.FORECAST)
    heading, tail = WAY[0].heading, WAY[0].tail
    ahead = [Point(x=x, y=y) for x, y in (tail + np.outer([0.012, 0.03], heading)).tolist()]
    refused = graph.call(ForecastPath, Service.FORECAST_PATH, 60.0, path=ahead, speed=0.004, horizon=1.0)
    assert "no estimate yet" in refused.message
    bench.show(0)
    graph.wait(lambda: len(forecasts) == 1, "a forecast")
    answer = graph.call(ForecastPath, Service.FORECAST_PATH, 60.0, path=ahead, speed=0.004, horizon=1.2)
    assert (answer.success, answer.message) == (True, "")
    found = answer.forecast
    assert found.header.stamp == stamp(0)
    assert found.horizon == pytest.approx(1.2)
    moved = math.hypot(found.tail[-1].x - found.tail[0].x, found.tail[-1].y - found.tail[0].y)
    assert 0.7 * 0.0048 < moved < 1.1 * 0.0048  # from rest
    assert len(found.positions) == 26 * len(found.time)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"path": []}, "path: got 0 points"),
        ({"path": [Point(x=math.nan)]}, "path: got a point that is not finite"),
        ({"horizon": math.inf}, "horizon: got inf"),
        ({"path": [Point()] * 1001}, "1001"),
    ],
)
def test_a_path_that_cannot_be_forecast_is_refused(fields: dict[str, Any], reason: str):
    given = {"path": [Point(x=0.01)], "speed": 0.002, "horizon": 1.0, **fields}
    with pytest.raises(InvalidInputError, match=re.escape(reason)):
        make_path_follower(ForecastPath.Request(**given), ThreadModelSettings())
