"""What the operator's page looks like at the sizes of a desk, a laptop and a phone, and what helps to read it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, ViewportSize, expect

from test.console.conftest import ServedConsole
from test.console.scene import TAIL, estimated_state, procedure_state
from test.console.test_page import Operator, operator

pytestmark = pytest.mark.slow

__all__ = ["operator"]  # the fixture

DESK, LAPTOP, PHONE = ((1600, 900), (1280, 720), (390, 844))
# Boxes of an element's visible part that lie outside of the one that clips it.
CUT_OFF = """(selector) => [...document.querySelectorAll(selector)].filter((element) => {
    const [box, clip] = [element.getBoundingClientRect(), element.closest("section").getBoundingClientRect()];
    return box.width > 0 && (box.left < clip.left || box.right > clip.right + 0.5);
}).map((element) => element.textContent)"""
ON_TOP = """(id) => {
    const element = document.getElementById(id), box = element.getBoundingClientRect();
    const found = document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2);
    return box.top >= 0 && box.bottom <= innerHeight && box.right <= innerWidth && element.contains(found);
}"""
RULER_STEP = 20  # [px]


def full_state() -> dict[str, Any]:
    """Return the state of a graph that shows as much as there is: an estimate, forces, a procedure that is ready."""
    shown = {**estimated_state(), **{name: procedure_state("ready")[name] for name in ("procedure", "procedures")}}
    shown["plan"] = [[0.0, 0.0], [TAIL[0] + 0.007 + 0.003, TAIL[1] + 0.004]]
    shown["predicted"] |= {"tension": [3e-5] * 39, "needle_force": [2e-6, 0.0]}
    return shown


@pytest.fixture(params=[DESK, LAPTOP, PHONE], ids=["desk", "laptop", "phone"])
def sized(request: pytest.FixtureRequest, browser: Browser, served: ServedConsole) -> Iterator[Operator]:
    """Open the page at a size, with all that it shows."""
    served.graph.shown = full_state()
    width, height = request.param
    context = browser.new_context(viewport=ViewportSize(width=width, height=height))
    opened = Operator(context.new_page(), served)
    expect(opened.page.locator("#margins")).to_contain_text("Needle pull2.00 µN")
    yield opened
    assert opened.complaints == []
    context.close()


def test_the_emergency_stop_is_in_sight_wherever_the_page_is_scrolled(sized: Operator):
    for place in (0, 10_000):
        sized.page.evaluate("(y) => { scrollTo(0, y); document.querySelector('aside').scrollTo(0, y); }", place)
        assert sized.page.evaluate(ON_TOP, "stop")


def test_no_figure_is_cut_off_and_the_legend_leaves_a_phone_its_dish(sized: Operator):
    page = sized.page
    assert page.evaluate(CUT_OFF, "#margins dd, #margins dt, #holder, #driver") == []
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    legend, fold = page.locator("#legend"), page.locator("#fold")
    is_phone = page.viewport_size == ViewportSize(width=PHONE[0], height=PHONE[1])
    (expect(legend).to_be_hidden if is_phone else expect(legend).to_be_visible)()
    fold.click()
    (expect(legend).to_be_visible if is_phone else expect(legend).to_be_hidden)()
    if is_phone:
        boxes = [page.locator(name).bounding_box() for name in ("#dish", "#legend")]
        assert boxes[0] is not None
        assert boxes[1] is not None
        assert boxes[1]["y"] >= boxes[0]["y"] + boxes[0]["height"]


def test_labels_of_shapes_overlap_nowhere(operator: Operator):
    script = "async ([wanted, widths]) => (await import('/shapes.js')).placeLabels(wanted, widths, 300)"
    widths = [60.0, 30.0, 70.0, 40.0]
    placed = operator.page.evaluate(script, [[[100, 50], [110, 52], [90, 50], [290, 50]], widths])
    assert placed[0][:2] == [100, 50]
    assert placed[3][:2] == [278, 50]  # inside
    for number, (x, y, half) in enumerate(placed):
        assert all(abs(x - u) >= half + other or abs(y - v) >= 14 for u, v, other in placed[:number])


def test_the_first_screen_is_calm_and_a_slow_machine_is_named(operator: Operator):
    graph, page = operator.served.graph, operator.page
    graph.shown["bridge"].update(armed=False, reasons=["disarmed"])
    rig = {"real_time_factor": "0.98", "skipped": "2"}
    graph.shown["nodes"]["rig_simulator"] = {"level": "ok", "message": "ready", "values": rig, "age": 0.1}
    expect(page.locator("#headline")).to_have_text("Disarmed: press Arm to enable commands")
    loud = "[data-level=warn]:visible, [data-level=error]:visible, .error:visible"
    expect(page.locator(loud)).to_have_count(0)
    operator.served.host.shown["busy"] = "starting hernia_ring"
    graph.shown["nodes"]["coil_bridge"].update(level="warn", message="loading the bridge's kernels")
    expect(page.locator("#nodes")).to_contain_text("coil bridge: starting")
    expect(page.locator(loud)).to_have_count(0)
    operator.served.host.shown["busy"] = ""
    rig.update(real_time_factor="0.61", skipped="73")
    expect(page.locator("#slow")).to_have_text("Machine too slow")
    expect(page.locator("#reasons")).to_contain_text("Simulated time runs at 61 %, with 73 frames skipped")


def test_the_ruler_measures_and_jogs_nothing(operator: Operator):
    operator.take_control()
    page, dish = operator.page, operator.page.locator("#dish")
    page.click("#ruler")
    box = dish.bounding_box()
    assert box is not None
    scale = float(dish.get_attribute("data-scale") or 0)
    u, v = (float(entry) for entry in (dish.get_attribute("data-centre") or "").split(","))
    x, y = box["x"] + u + scale * (TAIL[0] + 0.007), box["y"] + v - scale * TAIL[1]  # the needle's tip
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 3.0 * RULER_STEP, y + 4.0 * RULER_STEP)
    page.mouse.up()
    length = pytest.approx(1e3 * 5.0 * RULER_STEP / scale, abs=2e3 / scale)  # mm; pointers are rounded to pixels
    operator.until(lambda: float((dish.get_attribute("data-ruler") or "0").split()[0]) == length)
    assert operator.served.graph.commands == []
    page.click("#ruler")
    expect(dish).to_have_attribute("data-ruler", "")


def test_the_distance_from_the_tip_to_the_end_of_the_planned_way_is_given(operator: Operator):
    distance = operator.page.locator("#distance")
    operator.served.graph.shown = full_state()
    expect(distance).to_have_text("tip 5.0 mm from the end of the way")
    operator.served.graph.shown = procedure_state()
    expect(distance).to_be_empty()
