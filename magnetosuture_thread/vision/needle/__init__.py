"""The needle in a camera frame."""
