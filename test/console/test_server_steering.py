"""Steering through the server, with a client that is no browser and may lie: what moves and stops the needle."""

from __future__ import annotations

import asyncio
import contextlib
import math
from typing import Any

import pytest

from test.console.visitor import EAST, NORTH, REST, Console, run, until


def test_a_key_becomes_commands_until_it_is_released():
    async def test(here: Console) -> None:
        page = await here.page()
        await page.take()
        await page.hold(0, 1)
        await until(lambda: len(here.graph.commands) >= 4)
        await page.hold(1, 0, speed=99.0)
        await until(lambda: here.graph.last == (here.settings.max_speed, 0.0))
        await page.say(type="release")
        await until(lambda: here.graph.last == REST)
        assert here.graph.velocities[0] == NORTH
        assert here.graph.velocities.count(REST) == 1
        count = len(here.graph.commands)
        states = len(page.told)
        await until(lambda: len(page.told) > states + 3)
        assert len(here.graph.commands) == count

    run(test)


def test_the_first_command_does_not_wait_for_a_period():
    """At 10 Hz of commands ten keys in a row would take a second; each is passed on as it comes."""

    async def test(here: Console) -> None:
        page = await here.page()
        await page.take()
        angles = [0.1 * number for number in range(10)]
        for angle in angles:
            await page.hold(math.cos(angle), math.sin(angle))
        await until(lambda: len(here.graph.commands) >= 10)
        turned = [math.atan2(y, x) for x, y in here.graph.velocities[:10]]
        assert turned == pytest.approx(angles)

    run(test, rate=10.0, hold_timeout=1.0)


def test_silence_stops_the_needle_though_the_connection_stands():
    async def test(here: Console) -> None:
        page = await here.page()
        await page.take()
        await page.hold(1, 0)
        await until(lambda: here.graph.last == REST)
        first, last = here.graph.commands[0][0], here.graph.commands[-1][0]
        assert last - first >= here.settings.hold_timeout - 0.02
        assert page.lease["holder"] == page.number
        assert here.graph.velocities.count(REST) == 1

    run(test)


def test_a_connection_that_is_torn_stops_the_needle_before_any_timeout():
    async def test(here: Console) -> None:
        page, watcher = await here.page(), await here.page()
        await page.take()
        await page.hold(1, 0)
        await until(lambda: len(here.graph.commands) > 1)
        page.tear()
        await until(lambda: here.graph.last == REST)
        assert here.graph.commands[-1][0] - here.graph.commands[0][0] < 30.0
        await until(lambda: watcher.lease["holder"] is None)

    run(test, hold_timeout=1.0)


def test_words_that_the_network_held_up_move_nothing_and_a_page_that_stays_late_has_to_connect_again():
    async def test(here: Console) -> None:
        page = await here.page()
        await page.take()
        await page.hold(1, 0, sent=100.0)
        await page.hold(0, 1, sent=99.0)
        await until(lambda: here.graph.last == REST)
        assert "late" in page.of("error")[0]["text"]
        assert NORTH not in here.graph.velocities
        while not page.socket.closed:
            with contextlib.suppress(ConnectionError):
                await page.hold(0, 1, sent=99.0)
            await asyncio.sleep(0.02)
        assert NORTH not in here.graph.velocities
        await until(lambda: not here.server._clients)

    run(test)


def test_one_steers_and_the_other_watches_until_it_is_handed_back():
    async def test(here: Console) -> None:
        first, second = await here.page(), await here.page()
        await first.take()
        await second.say(type="take")
        refusal = (await until(lambda: second.of("done")))[0]["refusal"]
        assert f"page {first.number} steers" in refusal
        await second.hold(0, -1)
        await until(lambda: second.of("error"))
        for word in ({"type": "act", "action": "arm"}, {"type": "pause", "still": True}):
            await second.say(**word)
        await until(lambda: len(second.of("error")) == 3)
        assert (here.graph.commands, here.graph.actions, here.host.asked) == ([], [], [])
        await first.hold(1, 0)
        await first.say(type="hand_back")
        await until(lambda: second.lease["holder"] is None)
        assert here.graph.last == REST
        await second.take()
        assert first.lease["pages"] == 2
        await until(lambda: first.lease["holder"] == second.number)

    run(test)


def test_a_hidden_page_steers_nothing_and_may_be_relieved():
    async def test(here: Console) -> None:
        first, second = await here.page(), await here.page()
        await first.take()
        await first.hold(1, 0)
        await first.say(type="visible", seen=False)
        await first.hold(1, 0)
        await until(lambda: first.of("error"))
        assert here.graph.velocities[-1] == REST
        await until(lambda: second.lease["available"])
        await second.take()
        await first.say(type="visible", seen=True)
        await first.hold(1, 0)
        await until(lambda: len(first.of("error")) == 2)
        assert here.graph.velocities.count(REST) == 1

    run(test, hold_timeout=1.0)


def test_an_emergency_stop_of_anybody_rests_the_needle_until_the_key_is_let_go():
    async def test(here: Console) -> None:
        first, second = await here.page(), await here.page()
        await first.take()
        await first.hold(1, 0)
        await until(lambda: here.graph.last == EAST)
        await second.say(type="act", action="stop")
        await until(lambda: here.graph.actions == ["stop"])
        assert here.graph.last == REST
        count = len(here.graph.commands)
        await first.hold(1, 0)
        await first.say(type="act", action="reset")
        await until(lambda: here.graph.actions == ["stop", "reset"])
        await first.hold(1, 0)
        await first.say(type="act", action="arm")
        await until(lambda: here.graph.actions == ["stop", "reset", "arm"])
        assert len(here.graph.commands) == count
        await first.say(type="release")
        await first.hold(1, 0)
        await until(lambda: here.graph.last == EAST)

    run(test, hold_timeout=1.0)


@pytest.mark.parametrize(
    "between", [{"type": "nonsense"}, {"type": "hold", "direction": [1, 0], "speed": 1, "sent": 1}]
)
def test_what_cannot_be_used_does_not_lift_a_stop(between: dict[str, Any]):
    """A word that is refused or late is no key that was let go."""

    async def test(here: Console) -> None:
        page = await here.steering()
        await page.say(type="act", action="stop")
        await until(lambda: here.graph.actions == ["stop"])
        count = len(here.graph.commands)
        await page.say(**between)
        await page.hold(1, 0)
        await until(lambda: page.of("error"))
        await page.say(type="act", action="reset")
        await until(lambda: here.graph.actions == ["stop", "reset"])
        assert len(here.graph.commands) == count
        await page.say(type="release")
        await page.hold(1, 0)
        await until(lambda: here.graph.last == EAST)

    run(test, hold_timeout=1.0)


def test_a_bridge_that_somebody_else_disarms_asks_for_the_key_anew():
    async def test(here: Console) -> None:
        page = await here.steering()
        here.graph.shown["bridge"].update(armed=False, emergency_stopped=True)
        await until(lambda: here.graph.last == REST)
        here.graph.shown["bridge"].update(armed=True, emergency_stopped=False)
        count = len(here.graph.commands)
        await page.hold(1, 0)
        await page.say(type="act", action="reset")
        await until(lambda: here.graph.actions == ["reset"])
        assert len(here.graph.commands) == count
        await page.say(type="release")
        await page.hold(1, 0)
        await until(lambda: here.graph.last == EAST)

    run(test, hold_timeout=1.0)


def test_a_key_that_is_held_as_the_page_hides_has_to_be_let_go():
    async def test(here: Console) -> None:
        page = await here.page()
        await page.take()
        await page.hold(1, 0)
        await page.say(type="visible", seen=False)
        await page.say(type="visible", seen=True)
        await page.hold(1, 0)
        await page.say(type="record", on=True)
        await until(lambda: here.host.asked)
        assert here.graph.velocities == [EAST, REST]
        await page.say(type="release")
        await page.hold(1, 0)
        await until(lambda: here.graph.last == EAST)

    run(test, hold_timeout=1.0)
