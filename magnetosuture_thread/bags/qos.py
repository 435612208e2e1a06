"""Quality of service as a recorder tells it of a topic, in the words of today's rosbag2."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import yaml
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

OFFERED = "offered_qos_profiles"  # what a recorder calls it, in mcap and in sqlite3


def profiles(text: str) -> list[dict[str, Any]]:
    """Return the profiles of a topic's publishers, their policies named; none where they cannot be read.

    Up to Iron, policies were told by number. A reader that expects names cannot play such a topic.

    Args:
        text: YAML, as a recorder keeps it with a topic.
    """
    try:
        return [{**profile} for profile in dump_qos_v9(parse_qos(text))]
    except Exception:  # The parser raises whatever the text makes it stumble over.
        return []


def in_words(told: Sequence[dict[str, Any]]) -> str:
    """Return profiles as they are kept with a topic."""
    return yaml.safe_dump(list(told), sort_keys=False) if told else ""
