"""Procedures on the operator's page, in a real browser: planned, seen, run, paused, taken over, held and given up."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

from test.console.scene import procedure_state
from test.console.test_page import Operator, operator

pytestmark = pytest.mark.slow

__all__ = ["operator"]  # the fixture


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
