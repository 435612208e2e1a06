"""What the operator's page shows of a forecast, in a real browser."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

from test.console.scene import forecast_state, state
from test.console.test_page import Operator, operator

pytestmark = pytest.mark.slow

__all__ = ["operator"]  # the fixture


def test_the_forecast_thread_is_drawn_as_a_ghost_beside_the_thread(operator: Operator) -> None:
    graph, dish = operator.served.graph, operator.page.locator("#dish")
    graph.shown = state()
    expect(dish).to_have_attribute("data-ghosts", "0")
    expect(operator.page.locator("#forecast-legend")).to_be_hidden()
    ahead = forecast_state()
    places = [tuple(ghost["vertices"][38]) for ghost in ahead["forecast"]["ghosts"]]
    # A ghost is mixed with what is below it, so that its colour is that of no line.
    before = [operator.colours_at(place, 0) for place in places]
    graph.shown = ahead
    expect(dish).to_have_attribute("data-ghosts", "3")

    def all_differ() -> bool:
        return all(operator.colours_at(place, 0) != colour for place, colour in zip(places, before, strict=True))

    operator.until(all_differ)
    expect(operator.page.locator("#forecast-legend")).to_have_text("forecast for 3.0 s, fainter the later")
    expect(operator.page.locator("#forecast")).to_be_hidden()  # nothing happens


def test_a_shape_with_a_hostile_name_is_shown_as_text(operator: Operator) -> None:
    operator.served.graph.shown = forecast_state("touches the <b>ring</b> in 0.8 s")
    expect(operator.page.locator("#forecast")).to_have_text("Touches the <b>ring</b> in 0.8 s")
    assert operator.page.locator("#forecast b").count() == 0
