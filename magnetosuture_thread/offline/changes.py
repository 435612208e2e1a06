"""What a bag says of obstacles and thread while it runs, as settings: as `thread_model` takes it."""

from __future__ import annotations

from magnetosuture_thread.bags.reader import Record
from magnetosuture_thread.configuration import from_mapping, to_mapping
from magnetosuture_thread.interface import MATERIAL
from magnetosuture_thread.model import changes
from magnetosuture_thread.model.settings import ThreadModelSettings

CHANGING = (MATERIAL,)


def changed(settings: ThreadModelSettings, record: Record) -> ThreadModelSettings:
    """Return settings after a recorded message on one of these channels.

    Raises:
        BagError: it cannot be decoded.
        ConfigurationError: it cannot be used.
    """
    message = record.decode()
    values = changes.told_material(message)
    return from_mapping(ThreadModelSettings, {**to_mapping(settings), **values})
