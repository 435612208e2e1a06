"""Vision: from camera frames to the needle and the thread."""
