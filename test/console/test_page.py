"""The operator's page in a real browser: what it does with keys and mouse, what it shows, and what it lets go of."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, ViewportSize, expect

from test.console.conftest import Link, ServedConsole
from test.console.scene import TAIL, estimated_state, forecast_state, picture, procedure_state, state

pytestmark = pytest.mark.slow

WAIT_TIMEOUT = 15.0  # [s]
REST, EAST = (0.0, 0.0), (0.003, 0.0)
TIP = (TAIL[0] + 0.007, TAIL[1])  # m
LAPTOP, PHONE = ViewportSize(width=1366, height=768), ViewportSize(width=390, height=844)
ON_TOP = """(id) => {
    const element = document.getElementById(id), box = element.getBoundingClientRect();
    const found = document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2);
    return box.top >= 0 && box.bottom <= innerHeight && box.right <= innerWidth && element.contains(found);
}"""


def until(page: Page, condition: Callable[[], Any]) -> Any:
    """Wait until a condition holds, the browser going on meanwhile, and return what it gave."""
    end = time.monotonic() + WAIT_TIMEOUT
    while not (result := condition()):
        assert time.monotonic() < end, "the condition has not come true"
        page.wait_for_timeout(10)
    return result


class Operator:
    """Somebody before the page."""

    def __init__(self, page: Page, served: ServedConsole, token: bool = True) -> None:
        self.page, self.served = page, served
        self.complaints: list[str] = []
        page.on("console", lambda message: self._hear(message.type, message.text))
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("requestfailed", lambda request: self.complaints.append(f"{request.url} failed"))
        page.on("response", lambda response: self._hear("error" if response.status >= 400 else "", response.url))
        page.goto(served.url if token else served.url.split("#")[0])
        self.until(lambda: self.stats("states") > 1)

    def _hear(self, kind: str, text: str) -> None:
        if kind in ("error", "warning"):
            self.complaints.append(text)

    def until(self, condition: Callable[[], Any]) -> Any:
        """Wait until a condition holds."""
        return until(self.page, condition)

    def stats(self, name: str) -> int:
        """Return one of the page's counts."""
        return int(self.page.evaluate(f"window.console_stats.{name}"))

    def take_control(self) -> None:
        """Take control."""
        self.page.click("#control")
        expect(self.page.locator("#holder")).to_have_text("you have control")

    def hold(self) -> None:
        """Take control and hold a key, and wait until the needle is commanded to the east."""
        self.take_control()
        self.page.keyboard.down("ArrowRight")
        self.last(EAST)

    def tip(self) -> tuple[float, float]:
        """Return where the needle's tip is on the screen [px]."""
        return self.at(TIP)

    def at(self, point: tuple[float, float]) -> tuple[float, float]:
        """Return where a point of the dish [m] is on the screen [px]."""
        dish = self.page.locator("#dish")
        box, scale = dish.bounding_box(), float(dish.get_attribute("data-scale") or 0)
        assert box is not None
        u, v = (float(entry) for entry in (dish.get_attribute("data-centre") or "").split(","))
        return box["x"] + u + scale * point[0], box["y"] + v - scale * point[1]

    def last(self, velocity: tuple[float, float]) -> None:
        """Wait until this is the last command."""
        self.until(lambda: self.served.graph.last == pytest.approx(velocity, abs=1e-9))

    def nothing_more(self) -> None:
        """See that no command goes out while several states come."""
        before, seen = len(self.served.graph.commands), self.stats("states")
        self.until(lambda: self.stats("states") > seen + 5)
        assert len(self.served.graph.commands) == before

    def more_commands(self, count: int) -> None:
        """Wait until so many commands more have gone out."""
        before = len(self.served.graph.commands)
        self.until(lambda: len(self.served.graph.commands) > before + count)


@pytest.fixture
def operator(browser: Browser, served: ServedConsole) -> Iterator[Operator]:
    """Open the page on a laptop's screen; it must have nothing to complain of at the end."""
    context = browser.new_context(viewport=LAPTOP)
    opened = Operator(context.new_page(), served)
    yield opened
    assert opened.complaints == []
    assert opened.stats("errors") == 0
    context.close()


def test_the_page_loads_and_draws_every_state(operator: Operator):
    operator.served.graph.picture = (1, picture())
    expect(operator.page.locator("#dish")).to_have_attribute("data-image", "yes")
    expect(operator.page.locator("#simulated")).to_be_visible()
    expect(operator.page.locator("#headline")).to_have_text("At rest: no page has control")
    drawn, states = operator.stats("drawn"), operator.stats("states")
    operator.until(lambda: operator.stats("drawn") > drawn + 5)
    assert operator.stats("states") > states
    assert operator.stats("frames") == 1


def test_a_click_tells_which_end_of_the_needle_is_its_tip(operator: Operator):
    shown = operator.served.graph.shown
    shown.update(needle=None, axis=shown["needle"])
    dish = operator.page.locator("#dish")
    expect(dish).to_have_attribute("data-axis", "yes")
    expect(operator.page.locator("#headline")).to_have_text("Which end of the needle is the tip?")
    operator.page.mouse.click(*operator.tip())  # without control
    assert operator.served.graph.tips == []
    operator.take_control()
    operator.page.mouse.click(*operator.tip())
    operator.until(lambda: operator.served.graph.tips)
    assert operator.served.graph.tips == [pytest.approx(TIP, abs=1e-4)]
    expect(dish).to_have_attribute("data-axis", "no")
    assert operator.served.graph.commands == []


def test_the_needle_is_taught_by_a_click_on_each_of_its_ends(operator: Operator):
    graph, host, page = operator.served.graph, operator.served.host, operator.page
    graph.picture, graph.shown["bridge"]["armed"] = (1, picture()), False
    graph.shown.update(needle=None, axis=graph.shown["needle"])  # a click would tell the tip, but for the marks
    expect(page.locator("#dish")).to_have_attribute("data-image", "yes")
    expect(page.locator("#teach")).to_be_disabled()
    operator.take_control()
    page.click("#teach")
    expect(page.locator("#marking")).to_have_text("Click on the needle's tail; Escape ends this")
    page.keyboard.press("Escape")
    expect(page.locator("#marking")).to_be_empty()
    page.click("#teach")
    page.mouse.click(*operator.at(TAIL))
    expect(page.locator("#dish")).to_have_attribute("data-marks", "1")
    expect(page.locator("#marking")).to_have_text("Click on the needle's tip; Escape ends this")
    page.mouse.click(*operator.tip())
    operator.until(lambda: host.requests)
    # By the view of the frame: 80 µm a pixel, the dish's middle at 322, 238.
    assert host.requests == [("teach", pytest.approx((347.0, 113.0, 434.5, 113.0), abs=2.0))]
    expect(page.locator("#measurement")).to_have_text("teach: running")
    expect(page.locator("#measured")).to_have_text("at rest: 2 µm")
    for button in ("#teach", "#commission"):
        expect(page.locator(button)).to_be_disabled()
    host.shot = cv2.imencode(".png", np.zeros((30, 90, 3), np.uint8))[1].tobytes()
    host.shown["measurement"].update(state="done", picture="taught")
    operator.until(lambda: page.evaluate("document.querySelector('#learnt img').naturalWidth") == 90)
    expect(page.locator("#measurement")).to_have_attribute("data-level", "ok")
    assert graph.commands == []
    assert graph.tips == []


def test_a_rig_commissions_itself_and_is_cancelled_by_the_page(operator: Operator):
    graph, host, page = operator.served.graph, operator.served.host, operator.page
    operator.take_control()
    graph.shown["nodes"]["coil_bridge"]["values"] = {"commissioning": "True"}
    expect(page.locator("#headline")).to_have_text("The coil bridge commissions: it follows no jog")
    expect(page.locator("#commission")).to_be_disabled()  # as long as the bridge is armed
    graph.shown["bridge"]["armed"] = False
    for end in ("#cancel-measurement", "#disarm"):
        page.click("#commission")
        expect(page.locator("#measurement")).to_have_text("commission: running")
        expect(page.locator("#headline")).to_have_text("The rig commissions itself")
        graph.shown["bridge"]["armed"] = True  # by the command
        page.click(end)
        expect(page.locator("#measurement")).to_have_text("commission: failed")
        assert graph.actions.pop() == "disarm"
    assert host.requests == 2 * [("commission", ())]
    expect(page.locator("#headline")).to_have_text("The coil bridge commissions: it follows no jog")
    graph.shown["nodes"]["coil_bridge"]["values"] = {"commissioning": "False"}
    expect(page.locator("#commission")).to_be_disabled()
    expect(page.locator("#headline")).to_have_text("Disarmed: press Arm to enable commands")
    host.shown["can_measure"] = False
    expect(page.locator("#measure-card")).to_be_hidden()


KEYS = [
    (["ArrowRight"], (1.0, 0.0)),
    (["ArrowUp"], (0.0, 1.0)),
    (["ArrowLeft", "ArrowDown"], (-math.sqrt(0.5), -math.sqrt(0.5))),
    (["a", "w"], (-math.sqrt(0.5), math.sqrt(0.5))),
    (["ArrowLeft", "ArrowRight", "s"], (0.0, -1.0)),
]


def test_keys_jog_while_they_are_held(operator: Operator):
    operator.take_control()
    for keys, direction in KEYS:
        for key in keys:
            operator.page.keyboard.down(key)
        operator.last((0.003 * direction[0], 0.003 * direction[1]))
        operator.more_commands(5)
        for key in keys:
            operator.page.keyboard.up(key)
        operator.last(REST)


def test_gamepad_stick_jogs_after_it_was_centred(operator: Operator):
    operator.take_control()
    pad = "navigator.getGamepads = () => [{{connected: true, axes: [{}, {}]}}]"
    operator.page.evaluate(pad.format(0.0, -1.0))
    operator.nothing_more()  # it was pushed already when it came
    operator.page.evaluate(pad.format(0.1, 0.1))
    operator.nothing_more()  # a worn stick
    operator.page.evaluate(pad.format(0.0, -1.0))
    operator.last((0.0, 0.003))
    operator.page.evaluate(pad.format(0.575, 0.0))
    operator.last((0.0015, 0.0))
    operator.page.evaluate("window.dispatchEvent(new Event('gamepaddisconnected'))")
    operator.last(REST)
    operator.nothing_more()


def test_dragging_from_the_needle_jogs(operator: Operator):
    operator.take_control()
    (x, y), mouse, box = operator.tip(), operator.page.mouse, operator.page.locator("#dish").bounding_box()
    assert box is not None
    mouse.move(x + 150, y + 200)
    mouse.down()
    mouse.move(x + 160, y + 200)
    mouse.up()
    assert operator.served.graph.commands == []  # not from the needle
    mouse.move(x, y)
    mouse.down()
    mouse.move(x, y + 45)
    operator.until(lambda: operator.served.graph.last and operator.served.graph.last[1] < 0.0)
    mouse.move(x, y + 300)
    operator.until(lambda: operator.served.graph.last == pytest.approx((0.0, -0.003), abs=3e-5))
    mouse.move(box["x"] + box["width"] + 60, y)  # out of the dish
    operator.last(REST)
    mouse.move(x, y + 60)
    mouse.up()
    assert operator.served.graph.last == REST


def test_key_held_while_focus_is_lost_must_be_pressed_again(operator: Operator):
    operator.take_control()
    for lost in ("blur", "offline", "pagehide"):
        operator.page.keyboard.down("ArrowRight")
        operator.last(EAST)
        operator.page.evaluate(f"window.dispatchEvent(new Event('{lost}'))")
        operator.last(REST)
        operator.page.keyboard.down("ArrowRight")  # the browser repeats the key
        operator.nothing_more()
        operator.page.keyboard.up("ArrowRight")
    operator.page.keyboard.down("ArrowRight")
    operator.last(EAST)
    operator.page.context.set_offline(True)
    operator.last(REST)
    operator.page.context.set_offline(False)


def test_hidden_tab_stops_the_needle_and_loses_control(operator: Operator):
    operator.hold()
    hide = "Object.defineProperty(document, '{}', {{value: {}, configurable: true}})"
    operator.page.evaluate(hide.format("hidden", "true"))
    operator.page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    operator.last(REST)
    assert operator.served.graph.velocities.count(REST) == 1
    operator.until(lambda: operator.served.server._jog.available)


def test_space_stops_everything_wherever_the_focus_is(operator: Operator):
    operator.hold()
    operator.page.focus("#control")
    operator.page.keyboard.press("Space")
    operator.until(lambda: operator.served.graph.actions == ["stop"])
    assert operator.served.graph.last == REST
    expect(operator.page.locator("#headline")).to_have_text("Emergency stop is pressed")
    expect(operator.page.locator("#coils")).to_have_text("emergency stop")
    expect(operator.page.locator("#holder")).to_have_text("you have control")  # the button in focus was not pressed
    count = len(operator.served.graph.commands)
    operator.page.click("#reset")
    operator.page.click("#arm")
    expect(operator.page.locator("#coils")).to_have_text("armed")
    assert operator.served.graph.actions == ["stop", "reset", "arm"]
    assert len(operator.served.graph.commands) == count
    operator.page.keyboard.up("ArrowRight")
    operator.page.keyboard.down("ArrowRight")
    operator.last(EAST)


def test_lost_connection_stops_the_needle_and_control_is_not_resumed(operator: Operator):
    operator.hold()
    operator.served.tear()
    operator.last(REST)
    expect(operator.page.locator("#link")).to_contain_text("Connected as page 2")
    expect(operator.page.locator("#holder")).to_have_text("no page has control")
    operator.take_control()
    operator.nothing_more()
    operator.page.keyboard.up("ArrowRight")
    operator.page.keyboard.down("ArrowRight")
    operator.last(EAST)


@pytest.fixture
def far(browser: Browser, linked: tuple[ServedConsole, Link]) -> Iterator[tuple[Operator, Link]]:
    """Open the page over a link that may fail, and take control."""
    served, link = linked
    context = browser.new_context(viewport=LAPTOP)
    operator = Operator(context.new_page(), served)
    operator.take_control()
    yield operator, link
    assert operator.stats("errors") == 0
    context.close()


def test_a_link_that_dies_without_a_word_is_noticed_and_a_stop_over_it_is_doubted(far: tuple[Operator, Link]):
    (operator, link), notice = far, far[0].page.locator("#notice")
    link.mode = "dead"
    operator.page.keyboard.press("Space")  # within a second, nothing looks wrong
    expect(notice).to_have_text("The emergency stop may not have arrived: no answer. Use the one on the rig.")
    expect(operator.page.locator("#link")).to_have_text("Disconnected: nothing came for 3 s")
    assert "stop" not in operator.served.graph.actions
    operator.page.keyboard.press("Space")
    expect(notice).to_have_text("Not connected: the emergency stop was not sent. Use the one on the rig.")
    link.mode = "pass"
    expect(operator.page.locator("#link")).to_contain_text("Connected as page", timeout=1e3 * WAIT_TIMEOUT)
    expect(operator.page.locator("#holder")).to_have_text("no page has control")
    operator.page.keyboard.press("Space")
    expect(operator.page.locator("#headline")).to_have_text("Emergency stop is pressed")


def test_a_stop_that_was_doubted_and_arrives_is_doubted_no_more(far: tuple[Operator, Link]):
    (operator, link), notice = far, far[0].page.locator("#notice")
    link.mode = "stalled"
    operator.page.keyboard.press("Space")
    expect(notice).to_contain_text("may not have arrived")
    for size in (LAPTOP, PHONE):
        operator.page.set_viewport_size(size)
        operator.page.evaluate("scrollTo(0, 10_000)")
        assert operator.page.evaluate(ON_TOP, "notice")
    link.mode = "pass"
    expect(operator.page.locator("#headline")).to_have_text("Emergency stop is pressed", timeout=1e3 * WAIT_TIMEOUT)
    assert "stop" in operator.served.graph.actions
    operator.until(lambda: notice.is_hidden() or "may not" not in notice.inner_text())


@pytest.mark.parametrize("button", ["#arm", "#run-procedure"])
def test_what_is_pressed_while_the_link_stalls_starts_nothing_later(far: tuple[Operator, Link], button: str):
    operator, link = far
    graph = operator.served.graph
    graph.shown = procedure_state("ready")
    graph.shown["bridge"]["armed"] = button != "#arm"
    expect(operator.page.locator(button)).to_be_enabled()
    link.mode = "stalled"
    operator.page.click(button)
    operator.page.wait_for_timeout(1500)
    link.mode = "pass"
    operator.until(lambda: operator.page.locator("#notice").is_visible() or "disarm" in graph.actions)
    assert "arm" not in graph.actions
    assert graph.procedures == []


def test_what_is_pressed_while_the_page_hangs_starts_nothing_later(operator: Operator):
    """The browser keeps a press for a page that is busy; it tells when that was."""
    graph, page = operator.served.graph, operator.page
    graph.shown["bridge"]["armed"] = False
    operator.take_control()
    expect(page.locator("#arm")).to_be_enabled()
    page.focus("#arm")
    page.evaluate("setTimeout(() => { const end = performance.now() + 2000; while (performance.now() < end); }, 50)")
    page.wait_for_timeout(100)
    page.keyboard.press("Enter")
    operator.until(lambda: page.locator("#notice").is_visible() or "disarm" in graph.actions)
    assert "arm" not in graph.actions


def test_without_the_token_every_control_is_off(browser: Browser, served: ServedConsole):
    context = browser.new_context(viewport=LAPTOP)
    watcher = Operator(context.new_page(), served, token=False)
    expect(watcher.page.locator("#hint")).to_contain_text("only watches")
    for control in ("stop", "arm", "disarm", "reset", "control", "pause", "record", "setup"):
        expect(watcher.page.locator(f"#{control}")).to_be_disabled()
    watcher.page.keyboard.press("Space")
    expect(watcher.page.locator("#notice")).to_contain_text("only watches")
    assert served.graph.actions == []
    assert watcher.complaints == []
    context.close()


def test_a_release_reaches_the_page_whatever_element_has_the_focus(operator: Operator):
    """Each element is entered by keyboard and mouse, with what it opens left open, while a key is held and let go."""
    operator.take_control()
    count = operator.page.evaluate(
        """() => {
            const all = [...document.querySelectorAll("button, input, canvas, [tabindex], h1, #nodes")];
            const harmless = all.filter(({id}) => !["stop", "control", "disarm", "pause"].includes(id));
            window.elements = harmless.filter((element) => element.checkVisibility() && !element.disabled);
            return window.elements.length;
        }"""
    )
    assert count > 10
    for number in range(count):
        element = operator.page.evaluate_handle(f"window.elements[{number}]").as_element()
        assert element is not None
        for enter in (element.focus, partial(element.click, force=True), partial(element.press, "Enter")):
            operator.page.locator("#dish").focus()
            operator.page.keyboard.down("ArrowUp")
            operator.until(lambda: operator.served.graph.last and operator.served.graph.last[1] > 0.0)
            enter()
            operator.page.keyboard.up("ArrowUp")
            operator.last(REST)
            operator.page.keyboard.press("Escape")
    operator.nothing_more()


CAUSES: list[tuple[str, dict[str, Any], str]] = [  # why nothing moves, in the order in which they are to be resolved
    ("bridge", {"emergency_stopped": True, "state": "fault"}, "Emergency stop is pressed"),
    ("host", {"paused": True}, "Paused"),
    ("bridge", {"state": "inactive"}, "Coil bridge is inactive"),
    ("tracker", {"state": "lost", "reason": "no needle"}, "Needle lost: no needle"),
    ("needle", {"age": 2.0}, "Camera silent for 3"),  # the camera's age is added below
    ("bridge", {"armed": False}, "Disarmed: press Arm"),
    ("filter", {"reason": "stopped by ring"}, "At rest: stopped by ring"),
    ("filter", {"slowdown": 0.001}, "At rest: slowed to 0 % by friction"),
]


def test_a_held_key_without_motion_always_has_a_reason(operator: Operator):
    script = "async (view) => (await import('/status.js')).motionStatus(view).headline"
    for part, changes, expected in CAUSES:
        graph = {**state(), "camera": {"age": 3.0}}
        graph["tracker"]["age"] = 0.05
        graph["filter"]["commanded"] = [0.003, 0.0]
        view = {"link": "open", "since": 0.0, "graph": graph, "client": 1, "canCommand": True, "jogging": True}
        view |= {"late": 0, "host": {"mode": "simulated"}, "lease": {"holder": 1, "release_first": False}}
        {**graph, **view, "view": view}[part].update(changes)
        assert operator.page.evaluate(script, view).startswith(expected)


def test_estimate_disturbance_forecast_and_friction_are_shown_while_there_are_any(operator: Operator):
    graph, dish = operator.served.graph, operator.page.locator("#dish")
    graph.shown = estimated_state()
    expect(dish).to_have_attribute("data-estimate", "measured")
    expect(dish).to_have_attribute("data-disturbances", "1")
    expect(operator.page.locator("#margins")).to_contain_text("Held at 22 mm of the thread")
    graph.shown = forecast_state()
    expect(dish).to_have_attribute("data-estimate", "none")
    expect(dish).to_have_attribute("data-disturbances", "0")
    expect(dish).to_have_attribute("data-ghosts", "3")
    graph.shown = state("sliding", 4)
    expect(dish).to_have_attribute("data-ghosts", "0")
    expect(dish).to_have_attribute("data-friction", "sliding")
    graph.shown["margins"].update(valid=False, reason="no program was solved")
    expect(dish).to_have_attribute("data-friction", "invalid")
    graph.shown = state()
    graph.shown["predicted"]["age"] = 2.0
    expect(dish).to_have_attribute("data-friction", "old")


def test_a_shape_with_a_hostile_name_is_shown_as_text(operator: Operator) -> None:
    operator.served.graph.shown = forecast_state("touches the <b>ring</b> in 0.8 s")
    expect(operator.page.locator("#forecast")).to_have_text("Touches the <b>ring</b> in 0.8 s")
    assert operator.page.locator("#forecast b").count() == 0


@pytest.mark.parametrize("size", [LAPTOP, PHONE], ids=["laptop", "phone"])
def test_the_emergency_stop_is_in_sight_wherever_the_page_is_scrolled(operator: Operator, size: ViewportSize):
    operator.page.set_viewport_size(size)
    for place in (0, 10_000):
        operator.page.evaluate("(y) => { scrollTo(0, y); document.querySelector('aside').scrollTo(0, y); }", place)
        assert operator.page.evaluate(ON_TOP, "stop")


def test_a_person_stops_over_tls(browser: Browser, certificate: tuple[Path, Path]):
    path, key = map(str, certificate)
    served = ServedConsole(certificate=path, private_key=key)
    served.url = served.run(served.server.start())
    context = browser.new_context(ignore_https_errors=True)
    operator = Operator(context.new_page(), served)
    operator.page.keyboard.press("Space")
    operator.until(lambda: served.graph.actions == ["stop"])
    context.close()
    served.close()  # which holds that no connection is left open


def test_the_ruler_measures_and_jogs_nothing(operator: Operator):
    operator.take_control()
    page, dish = operator.page, operator.page.locator("#dish")
    page.click("#ruler")
    (x, y), scale = operator.tip(), float(dish.get_attribute("data-scale") or 0)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 60.0, y + 80.0)
    page.mouse.up()
    length = pytest.approx(1e3 * 100.0 / scale, abs=2e3 / scale)  # mm; pointers are rounded to pixels
    operator.until(lambda: float((dish.get_attribute("data-ruler") or "0").split()[0]) == length)
    assert operator.served.graph.commands == []
    page.click("#ruler")
    expect(dish).to_have_attribute("data-ruler", "")


def enabled(operator: Operator, *names: str) -> None:
    """Wait until these of the buttons are enabled, and no other."""
    for name in ("plan", "run", "pause", "abort"):
        button = operator.page.locator(f"#{name}-procedure")
        (expect(button).to_be_enabled if name in names else expect(button).to_be_disabled)()


def test_a_procedure_is_chosen_planned_seen_run_paused_resumed_and_given_up(operator: Operator):
    graph, page = operator.served.graph, operator.page
    graph.shown = procedure_state()
    enabled(operator)  # without control nothing
    operator.take_control()
    enabled(operator, "plan")
    page.click("#procedures button >> nth=1")
    page.click("#plan-procedure")
    operator.until(lambda: graph.procedures == [("plan", "slalom", False)])
    expect(page.locator("#dish")).to_have_attribute("data-plan", "3")
    enabled(operator, "plan", "run", "abort")
    page.click("#run-procedure")
    enabled(operator, "pause", "abort")
    page.click("#pause-procedure")
    enabled(operator, "run", "abort")
    page.click("#run-procedure")
    enabled(operator, "pause", "abort")
    page.click("#abort-procedure")
    expect(page.locator("#dish")).to_have_attribute("data-plan", "0")
    enabled(operator, "plan")
    assert [action for action, *_ in graph.procedures] == ["plan", "resume", "pause", "resume", "abort"]


def test_a_procedure_is_neither_begun_disarmed_nor_resumed_where_it_goes_on_by_itself(operator: Operator):
    graph = operator.served.graph
    graph.shown = procedure_state("ready")
    operator.take_control()
    enabled(operator, "plan", "run", "abort")
    graph.shown["bridge"]["armed"] = False
    enabled(operator, "plan", "abort")
    graph.shown = procedure_state("paused", reason="the needle is not tracked: lost", resumes=True)
    enabled(operator, "pause", "abort")
    waits = "the needle was not seen for more than 1.5 s: look, then resume"
    graph.shown = procedure_state("paused", reason=waits)
    enabled(operator, "run", "abort")
    expect(operator.page.locator("#procedure-reason")).to_have_text(waits)
    expect(operator.page.locator("#run-procedure")).to_have_text("Resume")


@pytest.mark.parametrize("end", ["release", "blur", "stop"])
def test_the_page_is_held_while_the_button_is_and_no_longer(operator: Operator, end: str):
    graph, page = operator.served.graph, operator.page
    graph.shown = procedure_state()
    operator.take_control()
    hold = page.locator("#hold-procedure")
    expect(hold).to_be_hidden()
    page.click("#hold-to-run")
    page.click("#plan-procedure")
    operator.until(lambda: graph.procedures == [("plan", "hernia", True)])
    page.click("#run-procedure")
    expect(hold).to_be_visible()
    assert graph.holds == []
    hold.hover()
    page.mouse.down()
    operator.until(lambda: len(graph.holds) > 3)
    if end == "blur":
        page.evaluate("window.dispatchEvent(new Event('blur'))")
    elif end == "stop":
        page.keyboard.press("Space")
    else:
        page.mouse.up()
    states = operator.stats("states")
    operator.until(lambda: operator.stats("states") > states + 3)  # what was sent before has come
    count, states = len(graph.holds), operator.stats("states")
    operator.until(lambda: operator.stats("states") > states + 5)
    assert len(graph.holds) == count
    page.mouse.up()


def test_behind_the_path_of_a_proxy_the_socket_is_beside_the_page(browser: Browser, served: ServedConsole):
    address, _, token = served.url.partition("#")
    page = browser.new_page()
    page.route("**/needle/*", lambda route: route.continue_(url=route.request.url.replace("/needle/", "/")))
    with page.expect_websocket() as socket:
        page.goto(f"{address}needle/#{token}")
    assert socket.value.url.startswith(f"{address.replace('http', 'ws')}needle/socket?token=")
    page.close()
