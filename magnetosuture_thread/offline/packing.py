"""Packs predictions and margins as CDR bytes, each with one format; a bag has one of each a pose."""

from __future__ import annotations

import struct
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from magnetosuture_thread.interface import DISH_FRAME
from magnetosuture_thread.model.friction import FrictionState
from magnetosuture_thread.model.margins import Margins
from magnetosuture_thread.model.predictor import Prediction

_BEGIN = b"\x00\x01\x00\x00"  # plain CDR, little endian; places count from behind it
_UNKNOWN, _FREE, _TOUCHING = 0, 1, 2  # as in SafetyMargins.msg
_KEPT = 256  # formats and texts; a run has a few
_KIND, _NODE, _OBSTACLE, _REAL = (np.dtype(code) for code in ("u1", "<u4", "<i4", "<f8"))


def packed_prediction(stamp: int, prediction: Prediction, material: str) -> bytes:
    """Return a PredictedThread; how long the step took is no property of it, and told as 0.

    Args:
        stamp: of the pose [ns].
        prediction: the thread.
        material: its name.
    """
    vertices = np.zeros((len(prediction.vertices), 3))
    vertices[:, :2] = prediction.vertices
    words = (prediction.formulation, prediction.scene_version, material, prediction.solver, prediction.status)
    formulation, scene, thread, solver, status = map(_text, words)
    sizes = (formulation[0], scene[0], thread[0], len(vertices), len(prediction.stretch), solver[0], status[0])
    return _BEGIN + _prediction_form(*sizes).pack(
        *divmod(stamp, 10**9),
        *_DISH,
        *formulation,
        *scene,
        *thread,
        len(vertices),
        _numbers(vertices, _REAL),
        len(prediction.stretch),
        _numbers(prediction.stretch, _REAL),
        *solver,
        *status,
        prediction.residual,
        prediction.interval,
        prediction.substeps,
        0.0,
    )


def packed_margins(stamp: int, margins: Margins | None, reason: str = "", scene_version: str = "") -> bytes:
    """Return a SafetyMargins: every barrier, the least of each kind, and what touches; or why there are none.

    Args:
        stamp: of the pose [ns].
        margins: of its prediction; None where there are none.
        reason: why there are none.
        scene_version: of the scene in force where there are none.
    """
    time = divmod(stamp, 10**9)
    if margins is None:
        scene, words = _text(scene_version), _text(reason)
        return _BEGIN + _no_margins_form(scene[0], words[0]).pack(
            *time, *_DISH, *scene, False, *words, *[0] * 6, _UNKNOWN, 0, FrictionState.UNKNOWN, 0, 1.0
        )
    count = len(margins.kind)
    friction = margins.friction
    scene = _text(margins.scene_version)
    form = _margins_form(scene[0], count, len(margins.least), len(margins.touching), len(friction.nodes))
    return _BEGIN + form.pack(
        *time,
        *_DISH,
        *scene,
        True,
        *_NO_REASON,
        count,
        _numbers(margins.kind, _KIND),
        count,
        _numbers(margins.node, _NODE),
        count,
        _numbers(margins.obstacle, _OBSTACLE),
        count,
        _numbers(margins.value, _REAL),
        count,
        _numbers(margins.clearance, _REAL),
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


_Text = tuple[int, bytes]  # as a message has it: its length and its bytes


@lru_cache(_KEPT)
def _text(value: str) -> _Text:
    data = value.encode() + b"\0"
    return len(data), data


_DISH, _NO_REASON = _text(DISH_FRAME), _text("")


def _numbers(values: ArrayLike, kind: np.dtype[np.generic]) -> bytes:
    return np.asarray(values, kind).tobytes()


@lru_cache(_KEPT)
def _prediction_form(
    formulation: int, scene: int, material: int, vertices: int, stretch: int, solver: int, status: int
) -> struct.Struct:
    """Return the format of a PredictedThread with texts of these lengths, and so many vertices and segments."""
    begin = (*_HEADER, *_text_codes(formulation), *_text_codes(scene), *_text_codes(material))
    arrays = (*_array_codes(vertices, "d", 3), *_array_codes(stretch, "d"))
    return _form(*begin, *arrays, *_text_codes(solver), *_text_codes(status), "d", "d", "I", "d")


@lru_cache(_KEPT)
def _margins_form(scene: int, barriers: int, least: int, touching: int, squeezed: int) -> struct.Struct:
    """Return the format of a SafetyMargins with a version of this length, and so many entries of each array."""
    arrays = [code for kind in "BIidd" for code in _array_codes(barriers, kind)]
    return _form(
        *_HEADER,
        *_text_codes(scene),
        "?",
        *_text_codes(_NO_REASON[0]),
        *arrays,
        "I",
        *"BIidd" * least,
        *_nodes(touching),
        *_nodes(squeezed),
        "d",
    )


@lru_cache(_KEPT)
def _no_margins_form(scene: int, reason: int) -> struct.Struct:
    """Return the format of a SafetyMargins without any, but texts of these lengths."""
    return _form(*_HEADER, *_text_codes(scene), "?", *_text_codes(reason), *"IIIIII", *_nodes(0), *_nodes(0), "d")


def _nodes(count: int) -> tuple[str, ...]:
    """Return the codes of a state and the nodes that it is about."""
    return "B", "I", *"I" * count


def _text_codes(length: int) -> tuple[str, ...]:
    return "I", f"{length}s"


def _array_codes(count: int, kind: str, width: int = 1) -> tuple[str, ...]:
    """Return the codes of a sequence, whose numbers come as bytes; of an empty one only the count is there."""
    aligned = (f"0{kind}",) if count else ()
    return "I", *aligned, f"{count * width * struct.calcsize('<' + kind)}s"


_HEADER = ("i", "I", *_text_codes(_DISH[0]))


def _form(*codes: str) -> struct.Struct:
    """Return the format of fields behind each other, each at a multiple of its size; `0d` only goes to such a place."""
    whole = "<"
    for code in codes:
        whole += f"{-struct.calcsize(whole) % struct.calcsize('<' + code[-1])}x{code}"
    return struct.Struct(whole)
