"""What a bag says of obstacles and thread while it runs, as settings: as `thread_model` takes it."""

from __future__ import annotations

from magnetosuture_thread.bags.reader import Record
from magnetosuture_thread.configuration import from_mapping, to_mapping
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.interface import DISH_FRAME, MATERIAL, OBSTACLE_SET
from magnetosuture_thread.model import changes
from magnetosuture_thread.model.settings import ThreadModelSettings

CHANGING = (OBSTACLE_SET, MATERIAL)


def changed(settings: ThreadModelSettings, record: Record) -> ThreadModelSettings:
    """Return settings after a recorded message on one of these channels.

    Raises:
        BagError: it cannot be decoded.
        ConfigurationError: it cannot be used.
        InvalidInputError: it is of another frame.
    """
    message = record.decode()
    if record.topic == OBSTACLE_SET.recorded:
        frame = message.header.frame_id
        if frame != DISH_FRAME:
            raise InvalidInputError(f"{OBSTACLE_SET.name}.header.frame_id", repr(frame), repr(DISH_FRAME))
        values = changes.told_obstacles(message)
    else:
        values = changes.told_material(message)
    return from_mapping(ThreadModelSettings, {**to_mapping(settings), **values})
