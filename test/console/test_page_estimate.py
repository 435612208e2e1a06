"""What the operator's page shows of the estimated thread, in a real browser."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

from test.console.scene import estimated_state, state
from test.console.test_page import Operator, between, operator

pytestmark = pytest.mark.slow

__all__ = ["operator"]  # the fixture

TEAL, MAGENTA, GREEN, RED = "#00a3a8", "#99107f", "#12a150", "#d1122f"


def test_estimate_prediction_and_measurement_have_their_own_colours(operator: Operator) -> None:
    graph = operator.served.graph
    operator.page.emulate_media(color_scheme="light")
    graph.shown = estimated_state()
    dish = operator.page.locator("#dish")
    expect(dish).to_have_attribute("data-estimate", "measured")
    assert operator.drawn("free") == GREEN
    at = between(36, 37)
    operator.until(lambda: {GREEN, TEAL} <= operator.colours_at(at, 5))
    x, y = graph.shown["predicted"]["vertices"][38]
    operator.until(lambda: MAGENTA in operator.colours_at((x, y), 6))
    expect(operator.page.locator("#margins")).to_contain_text("Measured50 %")
    expect(operator.page.locator("#margins")).to_contain_text("99 % bound")
    legend = operator.page.locator("#legend")
    for text in ("measured thread", "estimated", "predicted by the model alone"):
        expect(legend).to_contain_text(text)
    graph.shown = state()
    expect(dish).to_have_attribute("data-estimate", "none")
    operator.until(lambda: TEAL not in operator.colours_at(at, 5))
    expect(operator.page.locator("#margins")).not_to_contain_text("99 % bound")


def test_a_disturbance_is_marked_at_its_position_and_described(operator: Operator) -> None:
    graph = operator.served.graph
    operator.page.emulate_media(color_scheme="light")
    graph.shown = estimated_state(found=True)
    expect(operator.page.locator("#dish")).to_have_attribute("data-disturbances", "1")
    expect(operator.page.locator("#margins")).to_contain_text("Held at 22 mm of the thread: 0.2 mN up and to the left")
    found = graph.shown["estimated"]["disturbances"][0]
    x, y = found["position"]
    behind = (x - 1e-3 * found["direction"][0], y - 1e-3 * found["direction"][1])
    operator.until(lambda: RED in operator.colours_at(behind))
    graph.shown = estimated_state()
    expect(operator.page.locator("#dish")).to_have_attribute("data-disturbances", "0")
    operator.until(lambda: RED not in operator.colours_at(behind))
