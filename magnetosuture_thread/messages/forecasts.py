"""Messages of a forecast: ThreadForecast, and markers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.interface import FORECAST, THREAD_MARKERS
from magnetosuture_thread.messages.building import ADD, LINE_STRIP, TEXT, MessageBuilder

if TYPE_CHECKING:
    from magnetosuture_thread.forecast import Forecast

MAX_INSTANTS = 11  # of a message: the start, and ten after it
GHOSTS = 3  # instants that markers show
GHOST_COLOUR, WARNING_COLOUR = (0.45, 0.3, 0.75), (0.78, 0.06, 0.18)
TEXT_HEIGHT, LINE_WIDTH = 8e-4, 1.5e-4  # m
LIFETIME = 500_000_000  # ns


def forecast_message(builder: MessageBuilder, stamp: Any, forecast: Forecast) -> Any:
    """Return a ThreadForecast.

    Args:
        builder: of messages.
        stamp: of the needle's pose at the start.
        forecast: of a command that is held.
    """
    last = len(forecast.times) - 1
    shown = _instants(forecast, MAX_INSTANTS)
    contact, minima = forecast.first_contact, forecast.minima
    command = forecast.commanded[0] if last else np.zeros(2)
    return builder.make(
        FORECAST.type_name,
        header=builder.header(stamp),
        scene_version=forecast.scene_version,
        commanded=builder.vector(*command),
        horizon=forecast.horizon,
        converged=forecast.converged,
        problem=forecast.problem,
        time=builder.numbers("d", forecast.times[shown]),
        tail=builder.points(forecast.tails[shown]),
        heading=[builder.vector(*heading) for heading in forecast.headings[shown].tolist()],
        positions=builder.points(forecast.vertices[shown].reshape(-1, 2)),
        margin_names=list(minima),
        clearance=builder.numbers("d", [margin.value for margin in minima.values()]),
        clearance_time=builder.numbers("d", [margin.time for margin in minima.values()]),
        clearance_node=builder.numbers("I", [margin.node for margin in minima.values()]),
        clearance_shape=[margin.shape for margin in minima.values()],
        contact_time=math.nan if contact is None else contact.time,
        contact_shape="" if contact is None else contact.shape,
        contact_node=0 if contact is None else contact.node,
        friction_time=_time(forecast.first_friction),
        friction_nodes=builder.numbers("I", forecast.friction_nodes),
        rest_time=_time(forecast.rest_time),
        stopped_by=list(forecast.stopped_by),
        peak_tension=forecast.peak_tension,
        peak_needle_force=forecast.peak_needle_force,
    )


def forecast_markers(builder: MessageBuilder, stamp: Any, forecast: Forecast) -> Any:
    """Return a MarkerArray in the namespace `forecast`: the thread at three instants, and what happens when.

    The line is fainter the later the instant. The text stands beside the node of the first contact, else beside the
    needle's tail at the end. All disappear by themselves half a second after the last forecast.
    """
    shown, header = _instants(forecast, GHOSTS + 1)[1:], builder.header(stamp)
    lifetime = builder.make("builtin_interfaces/msg/Duration", sec=0, nanosec=LIFETIME)

    def marker(
        number: int, kind: int, size: tuple[float, float, float], colour: Any, alpha: float, **fields: Any
    ) -> Any:
        red, green, blue = colour
        return builder.make(
            "visualization_msgs/msg/Marker",
            header=header,
            ns="forecast",
            id=number,
            type=kind,
            action=ADD,
            scale=builder.vector(*size),
            color=builder.make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=alpha),
            lifetime=lifetime,
            **{"pose": builder.flat_pose(np.zeros(2), 0.0), **fields},
        )

    markers = [
        marker(
            number,
            LINE_STRIP,
            (LINE_WIDTH, 0.0, 0.0),
            GHOST_COLOUR,
            0.8 - 0.2 * number,
            points=builder.points(forecast.vertices[instant]),
        )
        for number, instant in enumerate(shown)
    ]
    contact, text = forecast.first_contact, forecast_text(forecast)
    if text:
        place = forecast.tails[-1]
        if contact is not None:
            place = forecast.vertices[int(np.searchsorted(forecast.times, contact.time)), contact.node]
        size = (0.0, 0.0, TEXT_HEIGHT)
        pose = builder.flat_pose(place, 0.0)
        markers.append(marker(GHOSTS, TEXT, size, WARNING_COLOUR, 1.0, text=text, pose=pose))
    return builder.make(THREAD_MARKERS.type_name, markers=markers)


def forecast_text(forecast: Forecast) -> str:
    """Return what will happen and when, for a person; empty where nothing does. See `forecast_events`."""
    contact = forecast.first_contact
    time, shape = (math.nan, "") if contact is None else (contact.time, contact.shape)
    return ", ".join(forecast_events(time, shape, _time(forecast.first_friction), _time(forecast.rest_time)))


def forecast_events(contact: float, shape: str, friction: float, rest: float) -> list[str]:
    """Return what will happen and when, for a person, the first event first. What holds already is not announced.

    Args:
        contact: when the thread first touches something [s]; NaN for never, as for the other times.
        shape: that it touches, or "wall".
        friction: when its first node is under friction [s].
        rest: when the needle comes to rest although it is commanded to move [s].
    """
    events = []
    if contact > 0.0:
        events.append((contact, f"touches the {shape.replace('_', ' ')} in {contact:.1f} s"))
    if friction > 0.0:
        events.append((friction, f"friction in {friction:.1f} s"))
    if rest >= 0.0:
        events.append((rest, f"needle rests in {rest:.1f} s" if rest > 0.0 else "needle rests"))
    return [text for _, text in sorted(events)]


def _instants(forecast: Forecast, count: int) -> NDArray[np.intp]:
    """Return evenly spaced instants with the first and the last among them, at most `count`."""
    return np.unique(np.linspace(0, len(forecast.times) - 1, count).round().astype(np.intp))


def _time(value: float | None) -> float:
    return math.nan if value is None else value
