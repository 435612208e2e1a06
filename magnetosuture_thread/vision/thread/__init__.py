"""The thread in a camera frame."""
