"""When a stamped input is good: not old, not from the future, not out of order."""

from __future__ import annotations

from magnetosuture_thread.errors import InvalidInputError

FUTURE = 0.05  # s; clocks of two machines may differ by this much


def check_stamp(topic: str, stamp: float, now: float, last: float, oldest: float) -> None:
    """Refuse a message by its stamp.

    Args:
        topic: of the message, for the error.
        stamp: of the message [s].
        now: the same clock now [s].
        last: stamp of the message before, -inf if there was none; one from the future, as after time was
            set back, is not compared with [s].
        oldest: how old it may be [s].

    Raises:
        InvalidInputError: it is not set, too old, from the future, or older than the last one.
    """
    field = f"{topic}.header.stamp"
    if stamp <= 0.0 or now <= 0.0:
        raise InvalidInputError(
            field, f"{stamp:g} s at the time {now:g} s", "a time: 0 is none in ROS, as before /clock"
        )
    if now - stamp > oldest:
        raise InvalidInputError(field, f"{now - stamp:.3f} s old", f"at most {oldest:g} s")
    if stamp - now > FUTURE:
        raise InvalidInputError(field, f"{stamp - now:.3f} s ahead", f"at most {FUTURE:g} s")
    if stamp < last <= now + FUTURE:
        raise InvalidInputError(field, f"{stamp:.6f} s", f"no earlier than the last one's {last:.6f} s")
