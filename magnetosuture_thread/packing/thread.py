"""Packs predictions and margins as CDR bytes, each with one format; there is one of each for every pose."""

from __future__ import annotations

import struct
from functools import lru_cache

import numpy as np

from magnetosuture_thread.model.friction import FrictionState
from magnetosuture_thread.model.margins import Margins
from magnetosuture_thread.model.predictor import Prediction
from magnetosuture_thread.packing.layout import (
    BEGIN,
    DISH,
    EMPTY,
    HEADER,
    KEPT,
    REAL,
    Time,
    array_codes,
    form,
    numbers,
    points_of,
    text,
    text_codes,
)

_UNKNOWN, _FREE, _TOUCHING = 0, 1, 2  # as in SafetyMargins.msg
_KIND, _NODE, _OBSTACLE = (np.dtype(code) for code in ("u1", "<u4", "<i4"))


def packed_prediction(time: Time, prediction: Prediction, material: str, *, step_time: float = 0.0) -> bytes:
    """Return a PredictedThread.

    Args:
        time: of the pose, seconds and nanoseconds.
        prediction: the thread.
        material: its name.
        step_time: wall-clock time that it took [s]; offline it is no property of a prediction, and told as 0.
    """
    vertices = prediction.vertices
    words = (prediction.formulation, prediction.scene_version, material, prediction.solver, prediction.status)
    formulation, scene, thread, solver, status = map(text, words)
    sizes = (formulation[0], scene[0], thread[0], len(vertices), len(prediction.stretch), solver[0], status[0])
    return BEGIN + _prediction_form(*sizes).pack(
        *time,
        *DISH,
        *formulation,
        *scene,
        *thread,
        len(vertices),
        points_of(vertices),
        len(prediction.stretch),
        numbers(prediction.stretch, REAL),
        *solver,
        *status,
        prediction.residual,
        prediction.interval,
        prediction.substeps,
        step_time,
    )


def packed_margins(time: Time, margins: Margins | None, reason: str = "", scene_version: str = "") -> bytes:
    """Return a SafetyMargins: every barrier, the least of each kind, and what touches; or why there are none.

    Args:
        time: of the pose, seconds and nanoseconds.
        margins: of its prediction; None where there are none.
        reason: why there are none.
        scene_version: of the scene in force where there are none.
    """
    scene = text(scene_version if margins is None else margins.scene_version)
    if margins is None:
        words = text(reason)
        return BEGIN + _no_margins_form(scene[0], words[0]).pack(
            *time, *DISH, *scene, False, *words, *[0] * 6, _UNKNOWN, 0, FrictionState.UNKNOWN, 0, 1.0
        )
    count = len(margins.kind)
    friction = margins.friction
    layout = _margins_form(scene[0], count, len(margins.least), len(margins.touching), len(friction.nodes))
    return BEGIN + layout.pack(
        *time,
        *DISH,
        *scene,
        True,
        *EMPTY,
        count,
        numbers(margins.kind, _KIND),
        count,
        numbers(margins.node, _NODE),
        count,
        numbers(margins.obstacle, _OBSTACLE),
        count,
        numbers(margins.value, REAL),
        count,
        numbers(margins.clearance, REAL),
        len(margins.least),
        *[
            number
            for least in margins.least
            for number in (least.kind, least.node, least.obstacle, least.value, least.clearance)
        ],
        _TOUCHING if margins.touching else _FREE,
        len(margins.touching),
        *margins.touching,
        friction.state,
        len(friction.nodes),
        *friction.nodes,
        friction.slowdown,
    )


@lru_cache(KEPT)
def _prediction_form(
    formulation: int, scene: int, material: int, vertices: int, stretch: int, solver: int, status: int
) -> struct.Struct:
    """Return the format of a PredictedThread with texts of these lengths, and so many vertices and segments."""
    begin = (*HEADER, *text_codes(formulation), *text_codes(scene), *text_codes(material))
    arrays = (*array_codes(vertices, "d", 3), *array_codes(stretch, "d"))
    return form(*begin, *arrays, *text_codes(solver), *text_codes(status), "d", "d", "I", "d")


@lru_cache(KEPT)
def _margins_form(scene: int, barriers: int, least: int, touching: int, squeezed: int) -> struct.Struct:
    """Return the format of a SafetyMargins with so many barriers, least ones, nodes that touch, and under friction."""
    arrays = [code for kind in "BIidd" for code in array_codes(barriers, kind)]
    return form(
        *HEADER,
        *text_codes(scene),
        "?",
        *text_codes(EMPTY[0]),
        *arrays,
        "I",
        *"BIidd" * least,
        *_nodes(touching),
        *_nodes(squeezed),
        "d",
    )


@lru_cache(KEPT)
def _no_margins_form(scene: int, reason: int) -> struct.Struct:
    """Return the format of a SafetyMargins without any, but a reason of this length."""
    return form(*HEADER, *text_codes(scene), "?", *text_codes(reason), *"IIIIII", *_nodes(0), *_nodes(0), "d")


def _nodes(count: int) -> tuple[str, ...]:
    """Return the codes of a state and the nodes that it is about."""
    return "B", "I", *"I" * count
